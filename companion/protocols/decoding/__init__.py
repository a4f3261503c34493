"""Common parts of all decoders: framing, checks, clocks, and commands to devices."""
