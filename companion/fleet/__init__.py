"""The fleet's end: collectors that put what aircraft tell into a database. No part of the daemon."""
