"""Experiments of PTASE (Fialho & Saotome 2005)."""
