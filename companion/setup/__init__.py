"""First-run set-up: detect devices by listening, ask the operator, and write the configuration."""
