"""One calibration or alignment from request to record."""
