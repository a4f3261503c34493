"""Interface to the autopilot's parameters, planned changes of them, and the check of a write's effect."""
