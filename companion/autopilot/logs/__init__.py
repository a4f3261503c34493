"""The logs that the autopilot keeps: which is the latest, and its bytes."""
