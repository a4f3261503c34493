"""The attitude sent to the autopilot, its supervision, and the autopilot settings required for it."""
