"""Light that has no place of its own: the sky's background, scattered light, a display's black level."""
