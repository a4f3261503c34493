"""Means over a window, with their variances: of IMUs, tilt, heading, and readings in coarse integers."""
