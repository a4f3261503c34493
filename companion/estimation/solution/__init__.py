"""From a window to biases, sigmas and the record."""
