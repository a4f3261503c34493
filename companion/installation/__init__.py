"""Installation of the companion as a service: its unit, udev rules, kernel modules and configuration."""
