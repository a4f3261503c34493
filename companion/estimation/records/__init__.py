"""Records of calibrations, alignments and flights, and the validity check of a calibration."""
