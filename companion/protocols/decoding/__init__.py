"""What all decoders share: framing, checks, clocks, and what is said to a device."""
