"""The active calibration, the arm gate, and automatic calibrations."""
