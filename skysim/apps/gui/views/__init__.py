"""The two views: the sensor's frame with its marks, and the laboratory in three dimensions."""
