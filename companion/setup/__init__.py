"""First-run set-up: listen, ask the owner, and write the configuration."""
