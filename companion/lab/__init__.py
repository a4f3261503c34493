"""Desk tools: replay of recordings and logs, noise profiles, reports and flights. The daemon imports none of them."""
