"""The daemon as a process: its tasks, the watchdog over them, and `companion check`."""
