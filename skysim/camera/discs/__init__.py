"""Images of bodies that are larger than a pixel: Sun, Moon and planets."""
