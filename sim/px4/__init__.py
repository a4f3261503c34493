"""The parts of the PX4 double; `sim.px4.double.Board` puts them together."""
