"""Sensor models and devices created from the configuration, for the daemon and for replays of recordings."""
