"""Whole trackers: frame to attitude under the stars and under a dome, tracking mode, exposure control."""
