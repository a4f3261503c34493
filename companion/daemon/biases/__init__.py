"""What is known of each IMU's biases from earlier power-ups, and whose it is."""
