"""The companion as MAVLink component 191: its heartbeat, commands, texts and parameters on the network."""
