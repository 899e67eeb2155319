"""Files that nobody wrote by hand, for every parser: bytes grown from a small corpus. See `fuzz.__main__`."""
