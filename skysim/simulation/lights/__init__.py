"""The lights of a scene: what shines, what hides it, and what air, wall and lens make of it; one module for each."""
