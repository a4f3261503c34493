"""Byte transport: serial ports, sockets and MAVLink; every link reconnects by itself after a loss."""
