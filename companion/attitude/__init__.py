"""Attitude estimation in flight from calibrated rates; without I/O and clock: all times come with the samples."""
