"""How a sensor scatters and wanders: Allan models, robust means."""
