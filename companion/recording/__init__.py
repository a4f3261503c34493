"""Recordings: MCAP files of the received bytes and of all other inputs of a calibration."""
