"""Memory of each IMU's biases from earlier power-ups, and the IMU's identity."""
