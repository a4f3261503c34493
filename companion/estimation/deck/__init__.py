"""Biases of IMUs on a platform that sways and turns: a boat at its mooring, a vehicle with a running engine."""
