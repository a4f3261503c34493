"""One-second batches of samples, and turns counted from samples."""
