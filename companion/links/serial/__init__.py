"""Serial ports: opening, reading, detection of devices, and faults."""
