"""The daemon's part of a fleet: what happened is kept, and sent until the fleet has confirmed it."""
