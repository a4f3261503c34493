"""Recordings: the bytes that came in, and what else a calibration was made from, as MCAP files."""
