"""From a bare board to a configuration: what is there, what its owner says, and the file that comes of both."""
