"""The parts of the PX4 double; `sim.px4.double.PX4Double` puts them together."""
