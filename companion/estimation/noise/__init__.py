"""Noise of sensors: Allan models, robust means."""
