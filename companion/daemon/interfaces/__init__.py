"""Interfaces: control socket, headline, MAVLink component, and the child processes for page and MQTT."""
