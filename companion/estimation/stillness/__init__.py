"""Stillness of the aircraft: gates, learned noise and the still stretch."""
