"""Parts of the ArduPilot double: channels, parameters, inertial path, messages, calibrations, faults."""
