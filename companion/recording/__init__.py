"""Recordings: everything that came and went, in the order of events, so that a calibration can be replayed exactly."""
