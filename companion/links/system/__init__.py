"""TCP, retries, budgets, the service manager: the common parts of all links."""
