"""Rate at which the ground under the aircraft turns, with a sigma."""
