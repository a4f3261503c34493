"""The process: what runs, who watches it, and the check without running."""
