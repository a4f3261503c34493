"""Readers of recordings and of logs, one for each format."""
