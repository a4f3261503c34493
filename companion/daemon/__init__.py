"""The service: wiring, and the conduct of a calibration."""
