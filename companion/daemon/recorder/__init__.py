"""The recording of everything a calibration is made of."""
