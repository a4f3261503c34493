"""From the configuration to the devices and models that daemon and replay work with."""
