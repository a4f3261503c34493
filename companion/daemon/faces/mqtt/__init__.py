"""The MQTT face: what the daemon does as topics, requests of others as what the daemon does."""
