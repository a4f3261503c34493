"""Fleet server, not part of the daemon: collectors write calibrations and other results of aircraft to a database."""
