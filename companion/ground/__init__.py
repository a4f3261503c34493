"""Client of the companion on a pilot's laptop, over the telemetry link and without a ground station program.

The package is an interface to people over MAVLink and uses no part of the daemon, which runs on the aircraft. Only this
package imports MAVSDK, when one of its commands runs.
"""
