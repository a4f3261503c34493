"""Rolling collector: input streams of the sensors, reasons to wait, and the decision that a window is long enough."""
