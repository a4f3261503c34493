"""Pages about calibrations, each one file that needs nothing else: no network, no scripts, light and dark."""
