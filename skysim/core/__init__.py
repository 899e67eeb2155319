"""Array types, constants, time scales, errors, units, paths, compiled loops, plug-ins, and safe file access. Imports
nothing else of skysim.
"""

__version__ = "0.1.0"  # of skysim; here, so that modules can import it without the package that imports them all
