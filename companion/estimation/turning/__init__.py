"""Whether what the aircraft stands on turns, how fast, and who says so."""
