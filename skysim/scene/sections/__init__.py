"""The schema of each section of a scene file: camera, light, motion, tracker, vehicle."""
