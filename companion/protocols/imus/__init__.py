"""Decoders of inertial measurement units."""
