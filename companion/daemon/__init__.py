"""The daemon: its subsystems, and the process that runs them."""
