"""Alignment of gradienter and accelerometers with the aircraft, from several stands."""
