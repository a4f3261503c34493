"""Common parts of all links: TCP, retries, budgets, the service manager."""
