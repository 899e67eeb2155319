"""Pictures of the laboratory: shapes, MJCF for MuJoCo's viewer, and rendered views."""
