"""The laboratory in three dimensions."""
