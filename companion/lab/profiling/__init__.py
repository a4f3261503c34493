"""An IMU's noise profile from a long recording at rest."""
