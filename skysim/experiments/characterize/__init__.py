"""A camera from its own frames: sensor from darks and flats, lens from the night sky (`skysim characterize`)."""
