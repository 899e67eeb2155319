"""LEDs in time: the clocks of their controllers, and codes that give each LED a name."""
