"""What is in force, whether it may arm, and what happens at arming."""
