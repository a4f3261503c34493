"""Parts of the PX4 double; `sim.px4.double.PX4Board` combines them."""
