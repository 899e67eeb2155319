"""Identification of LEDs under a dome: index of pairs, search, and evidence."""
