"""Calibration from frames: the camera from star fields, and the dome's LEDs, lever arm and lens at once."""
