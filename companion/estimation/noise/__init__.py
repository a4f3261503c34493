"""Noise of sensors: Allan models, robust means and lines."""
