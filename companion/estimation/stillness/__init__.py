"""Whether the aircraft stands still, and since when."""
