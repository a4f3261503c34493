"""Parts that the doubles of both firmwares share: ports, their loop, faults, common messages."""
