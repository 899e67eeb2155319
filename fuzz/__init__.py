"""Fuzzing of all parsers with mutated files, starting from a small corpus. See `fuzz.__main__`."""
