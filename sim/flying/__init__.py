"""Flights of real firmware by its own physics; the sensors follow its truth: effects of faults on the heading."""
