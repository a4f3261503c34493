"""The attitude sent to the autopilot, the supervision of it, and the autopilot settings that it needs."""
