"""A sensor from darks and flats, by the photon transfer method. Nothing here imports the simulated detector."""
