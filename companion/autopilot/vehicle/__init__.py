"""The autopilot on the link: heartbeats, arm state, place, clock, estimator; commands to it, and its parameters."""
