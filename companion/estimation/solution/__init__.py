"""Estimation of biases from a motionless window, combination with earlier calibrations, and the result as a record."""
