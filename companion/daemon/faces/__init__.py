"""How people and programs ask: control socket, own parameters, MQTT."""
