"""The autopilot's parameters: reads, writes one by one while disarmed, and the check of a write's effect."""
