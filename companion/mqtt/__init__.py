"""The MQTT process: a client of the daemon on one side and of the broker on the other."""
