"""The attitude while it is sent to the autopilot, and the set-up it needs there."""
