"""Writes to the autopilot: plan, journal, check of the effect, recovery and undo, and other writers."""
