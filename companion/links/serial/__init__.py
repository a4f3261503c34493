"""Serial ports: opening, reading, and what can be wrong with them."""
