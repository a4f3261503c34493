"""Interfaces: control socket, headline, MAVLink component, and the child processes for web page and MQTT."""
