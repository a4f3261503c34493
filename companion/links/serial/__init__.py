"""Serial ports: opening, reading, and their faults."""
