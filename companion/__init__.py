"""Field self-calibration of gyro and accelerometer biases for small aircraft."""

__version__ = "0.2.0"
