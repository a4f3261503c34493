"""Measurement of still windows, and alignments from several poses: gradienter zero, six positions, turn in place."""
