"""One still window; and what is made of several: alignments, accelerometers from faces, turns on the spot."""
