"""A star tracker's laboratory in software."""

__version__ = "0.1.0"
