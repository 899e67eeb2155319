"""Checks of a plan under the stars: how deep the camera sees, and whether the claimed errors will be true."""
