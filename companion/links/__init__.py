"""Byte transport: serial ports, sockets and the MAVLink codec; every link reconnects by itself after a loss."""
