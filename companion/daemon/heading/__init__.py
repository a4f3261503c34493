"""The attitude sent to the autopilot, its supervision, and the settings that the autopilot needs for it."""
