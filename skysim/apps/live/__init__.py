"""Real-time stream of a scene's frames, for trackers in other programs or on other processors."""
