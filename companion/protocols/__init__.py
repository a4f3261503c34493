"""Bytes to samples, samples to commands; no I/O, no clock."""
