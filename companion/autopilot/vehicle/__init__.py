"""The autopilot on the link: heartbeats, arm state, place, clock and estimator; its commands and parameters."""
