"""Pictures of the laboratory: its shapes, its MJCF for MuJoCo's own viewer, and rendered views."""
