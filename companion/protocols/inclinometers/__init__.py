"""Decoders of gradienters (two-axis tilt sensors)."""
