"""Images of a survey on disk, read at once or as they arrive."""
