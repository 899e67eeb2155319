"""A measurement model from a datasheet: attitude errors without frames, for simulations of others."""
