"""MAVLink component 191: the companion as the rest of the network sees it."""
