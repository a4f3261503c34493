"""The rolling collector: what comes in, what it waits for, when it has enough."""
