"""Array types, errors, units, paths, compiled loops, and safe file access. Imports nothing else of skysim."""
