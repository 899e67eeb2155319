"""Reads and writes files with care: atomic writes, YAML, images, and guarded readers of foreign files."""
