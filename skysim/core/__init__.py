"""Array types, errors, units, paths, compiled loops, and safe reading and writing of files. Imports nothing else of
skysim.
"""
