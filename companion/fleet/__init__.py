"""Fleet server: collectors that write the items of aircraft into a database. Not part of the daemon."""
