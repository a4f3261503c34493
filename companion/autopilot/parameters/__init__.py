"""The autopilot's parameters: read, written one by one while disarmed, read back."""
