"""Light sources: the stars of a catalog and the LEDs of a dome, as `Sources` with a direction or a place, a strength
and a pulse train.
"""
