"""Orbits around the Earth: that of the camera, satellites and their light, and the Earth in the way."""
