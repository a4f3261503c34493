"""What is kept of calibrations and alignments, and whether it is still good."""
