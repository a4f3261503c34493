"""The process: what runs, who watches it, reload, and the check without running."""
