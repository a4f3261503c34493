"""Parts of the PX4 double; `sim.px4.double.Board` combines them."""
