"""The autopilot's IMUs in its messages, and the attitude that is sent to it."""
