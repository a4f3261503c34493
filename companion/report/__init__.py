"""Building blocks of HTML pages, shared by reports, the live page and the fleet."""
