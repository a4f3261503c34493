"""Estimation of biases and their sigmas from still readings; without I/O, clock and event loop."""
