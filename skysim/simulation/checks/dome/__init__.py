"""Checks of a dome: assumptions that it breaks, and fields that look alike."""
