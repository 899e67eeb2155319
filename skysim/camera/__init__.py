"""Photons to digital numbers: optics, point-spread function, smear and the detector. Independent of the vehicle."""
