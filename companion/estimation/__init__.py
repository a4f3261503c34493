"""Estimation: stillness, averages, biases and their sigmas. No I/O, no clock, no event loop."""
