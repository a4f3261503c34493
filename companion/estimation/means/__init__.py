"""Means over a window of seconds, with their variances: IMUs, tilt, heading, coarse integers."""
