"""MAVLink on the wire: transports, frames, signatures."""
