"""Commands `companion ground`: clients of the companion on a pilot's laptop, over the telemetry link.

They need no ground station program. This package uses no part of the daemon, which runs on the aircraft. Only this
package imports MAVSDK, and only when one of its commands runs.
"""
