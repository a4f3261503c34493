"""Frames, the Earth, gradienter laws, quantisation: pure functions."""
