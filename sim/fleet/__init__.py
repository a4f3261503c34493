"""Simulated aircraft that tell a fleet's collector what happens to them."""
