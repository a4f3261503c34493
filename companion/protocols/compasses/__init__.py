"""Decoders of compasses."""
