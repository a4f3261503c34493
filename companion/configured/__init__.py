"""Devices and models made from the configuration, for daemon and replay."""
