"""The point-spread function: transfer functions, pixel-integrated kernels, their cache, and the loop that
adds them to pixels.
"""
