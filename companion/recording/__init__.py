"""Recordings: MCAP files of the bytes that came in, and what else a calibration was made from."""
