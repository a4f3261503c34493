"""Offline tools: replay, noise profiles, flights. Readers raise StorageError, in one line, for an unusable file."""
