"""MQTT process: a client of the daemon and of the broker."""
