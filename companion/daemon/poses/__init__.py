"""Measurements without motion, and alignments from several poses: gradienter zero, six positions, turn in place."""
