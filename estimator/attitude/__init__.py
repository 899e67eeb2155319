"""Attitude from vectors: solvers of Wahba's problem, and of the near-field problem under an LED dome."""
