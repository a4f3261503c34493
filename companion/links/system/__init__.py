"""Common parts of all links: TCP, retries, limits on incoming bytes, child processes, the service manager."""
