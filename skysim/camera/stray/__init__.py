"""Stray light: the dome's reflections as the camera sees them, ghosts of the lens, and its veiling glare."""
