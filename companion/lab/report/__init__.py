"""Reports of calibrations and flights as HTML files."""
