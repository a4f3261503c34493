"""Telemetry: samples of the autopilot's IMUs, and the attitude that we send to it."""
