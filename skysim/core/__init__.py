"""Array types, errors, units, paths, compiled loops, and careful reading and writing of files. Imports
nothing else of skysim.
"""
