"""Control socket, own MAVLink parameters, and the child processes for page and MQTT."""
