"""The mutation score of the tests. See `tests.mutants.__main__`."""
