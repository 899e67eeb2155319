"""Light sources: stars of a catalog and LEDs of a dome, as `Sources` with direction or place, strength and pulses."""
