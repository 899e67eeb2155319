"""Run a scene: build the test bed, step the dynamics, expose the frames, close the loop. Owns the random streams."""
