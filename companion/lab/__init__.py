"""Offline tools: replay, noise profiles, flights. File readers raise StorageError, in one line, for unusable files."""
