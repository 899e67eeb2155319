"""The worker process of a browser tab: holds scene and tracker, renders, solves and simulates."""
