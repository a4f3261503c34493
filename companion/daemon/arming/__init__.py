"""The active calibration, the gate that allows or refuses arming, and automatic calibrations."""
