"""The process behind a browser tab: it holds the scene and the tracker, and does the work."""
