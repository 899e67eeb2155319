"""`skysim balance`: measure inertia and center of mass with the star tracker, and move trim masses to balance."""
