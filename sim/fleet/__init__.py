"""Simulated aircraft that report to a fleet's collector."""
