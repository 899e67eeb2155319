"""Photons to digital numbers: optics, point-spread function, smear and the detector. Knows nothing of the
vehicle.
"""
