"""Component 191: what the companion is to the rest of the MAVLink network."""
