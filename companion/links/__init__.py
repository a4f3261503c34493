"""Bytes in and out: serial ports, sockets and the MAVLink codec; each comes back by itself after a loss."""
