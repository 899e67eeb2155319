"""The point-spread function: transfer functions, pixel-integrated kernels, their cache, and the loops that add them
to pixels.
"""
