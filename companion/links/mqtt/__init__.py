"""MQTT: the client, what it lets in, what it keeps for later."""
