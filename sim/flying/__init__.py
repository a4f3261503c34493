"""Flights of real firmware with its own physics, whose truth our sensors follow: effects of faults on the heading."""
