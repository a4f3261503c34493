"""Gradienter and accelerometers against the aircraft, from several stands."""
