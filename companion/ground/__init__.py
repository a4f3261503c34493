"""The companion from the ground: a pilot's laptop on the telemetry link, without a ground station program.

A face: it knows MAVLink and people, and nothing of the daemon, which runs on the aircraft. MAVSDK is imported here
only, and only when one of the commands runs.
"""
