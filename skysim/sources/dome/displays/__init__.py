"""Stars shown by displays: an LCD panel, a projector, a collimated micro-display."""
