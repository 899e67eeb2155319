"""Fuzzing of all parsers with mutated files, starting from a small corpus. See `tests.fuzz.__main__`."""
