"""Sun, Moon and planets: places, magnitudes and discs."""
