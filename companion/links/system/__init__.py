"""What every link shares: TCP, retries, budgets, the service manager."""
