"""Pure functions: frames and rotations, the Earth's gravity and magnetic field, tilt sensors, statistics."""
