"""The autopilot over MAVLink: its state, its parameters, its IMUs."""
