"""Attitude through the flight: carried from one IMU, pushed to the autopilot, compared with the autopilot's own.

Nothing of this is imported where `push.attitude` is "off".
"""
