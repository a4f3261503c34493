"""The autopilot over MAVLink: its state, its parameters and its IMUs."""
