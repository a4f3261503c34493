"""What the autopilot is and says of itself: heartbeats, arm state, place, clock; and commands to it."""
