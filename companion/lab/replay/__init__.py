"""Runs the same protocols and the same estimator over a recording, or over somebody's own log."""
