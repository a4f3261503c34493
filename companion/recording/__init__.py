"""Recordings: files in MCAP format with the received bytes and all other inputs of a calibration."""
