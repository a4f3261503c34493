"""Real autopilots on the virtual aircraft: physics for their binaries, run as child processes."""
