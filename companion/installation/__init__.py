"""Putting the companion in place as a service: its unit, udev rules, modules and configuration."""
