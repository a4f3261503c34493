"""Writing to the autopilot: the plan, the ledger, what is put back, what else writes there."""
