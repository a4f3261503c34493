"""Attitude estimation in flight from calibrated rates: no I/O, no clock; time comes in with the samples."""
