"""The calibration in force, the arm gate, and automatic calibrations."""
