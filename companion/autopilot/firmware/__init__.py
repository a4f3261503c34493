"""What is particular to ArduPilot and PX4: which parameters hold what, and who else changes them."""
