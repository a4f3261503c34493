"""A virtual aircraft and the devices, autopilots and faults around it."""
