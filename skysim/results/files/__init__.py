"""Files of a run: frames, recordings, and exports for other tools."""
