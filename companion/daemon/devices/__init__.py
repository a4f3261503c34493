"""What is read: serial devices, the autopilot, and what is wrong with them."""
