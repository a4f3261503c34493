"""One-second batches of samples, and turns of the aircraft integrated from gyro samples."""
