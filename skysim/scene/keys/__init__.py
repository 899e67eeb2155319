"""The keys of a scene: which of them have no effect, and where the value of each comes from."""
