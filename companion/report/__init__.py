"""Building blocks of HTML pages, shared by calibration reports, the live page and the fleet's pages."""
