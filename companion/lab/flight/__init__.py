"""A flight controller's log after a flight: what calibrating was worth, and what the biases did in the air."""
