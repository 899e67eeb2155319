"""Light that the dome's wall and the floor reflect: a diffuse glow, and mirror images of the LEDs."""
