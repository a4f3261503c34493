"""Real autopilots on the virtual aircraft: physics for their binaries, which a path names, run as child processes."""
