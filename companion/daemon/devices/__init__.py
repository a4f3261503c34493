"""Serial devices, the autopilot's IMUs, and their health."""
