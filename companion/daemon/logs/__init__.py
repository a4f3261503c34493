"""Logs of flights, fetched from the autopilot."""
