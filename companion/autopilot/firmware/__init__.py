"""Firmwares: ArduPilot and PX4, each an object with everything that is specific to it."""
