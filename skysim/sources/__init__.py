"""What shines: stars of a catalog and LEDs of a dome, as `Sources` with a direction or a place, a strength
and pulses.
"""
