"""Field self-calibration of gyro and accelerometer biases for small aircraft."""

__version__ = "0.1.0"
