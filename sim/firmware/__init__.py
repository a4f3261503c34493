"""What the doubles of both firmwares share: ports, the loop they run on, faults, common messages."""
