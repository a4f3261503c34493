"""Files with data that must survive a power cut."""
