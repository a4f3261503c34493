"""The companion from the ground: a pilot's laptop on the telemetry link, without a ground station program.

A face: it knows MAVLink and people, and nothing of the daemon, which runs on the aircraft.
"""
