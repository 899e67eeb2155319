"""Vectors to attitude: solvers of Wahba's problem, and of the near-field problem under a dome."""
