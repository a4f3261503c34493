"""Records of calibrations, alignments and flights, and whether a calibration is still good."""
