"""Framing, checks, clocks and dialogues of all decoders."""
