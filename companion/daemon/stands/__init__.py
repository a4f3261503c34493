"""Measurement of still windows, and alignments from several: gradienter, six positions, turn on the spot."""
