"""MQTT process, separate from the daemon: a client of the daemon and of an MQTT broker."""
