"""Alignment of the gradienter (tilt sensor) and the accelerometers with the aircraft, from several poses."""
