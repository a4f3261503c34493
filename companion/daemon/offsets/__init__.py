"""Offsets written to the autopilot: plan, journal, check of the effect, recovery, undo, and other writers."""
