"""Firmwares: one object each for all that is particular to ArduPilot or PX4."""
