"""Layouts of the LEDs on a dome, by kind; `registry.LAYOUTS` has all of them."""
