"""Rolling collector: input streams, wait conditions, and the decision that a window is enough."""
