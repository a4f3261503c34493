"""Samples gathered into batches of one second."""
