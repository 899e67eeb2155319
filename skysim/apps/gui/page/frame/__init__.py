"""The sensor view: a frame with its marks, and the tools to read it."""
