"""Stillness of the aircraft: gates on motion, learned noise, and checks of readings at rest."""
