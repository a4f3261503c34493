"""Calibrations, alignments and undos, from request to record."""
