"""Real firmware flies by its own physics; the sensors follow its truth: what faults do to the heading."""
