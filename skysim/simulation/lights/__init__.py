"""The lights of a scene: sources, obstacles that hide them, and the effects of air, wall and lens."""
