"""The scene of a worker: its geometry for the 3-D view, where the camera points, and the plan of its use."""
