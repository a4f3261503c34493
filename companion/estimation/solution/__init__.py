"""Biases and sigmas from a window, combined with earlier calibrations, and the record."""
