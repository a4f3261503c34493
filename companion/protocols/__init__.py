"""Protocols of sensors: decoders from bytes to samples, and commands to devices; no I/O, no clock."""
