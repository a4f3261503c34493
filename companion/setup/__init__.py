"""First-run set-up: detects devices by listening, asks the operator, and writes the configuration file."""
