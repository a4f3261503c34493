"""A bias by temperature: what still seconds of many power-ups tell of the next one."""
