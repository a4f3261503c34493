"""Estimation of biases from one still window, combination with earlier calibrations, and the result as a record."""
