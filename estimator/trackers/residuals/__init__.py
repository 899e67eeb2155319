"""What the residuals of a solution tell: other matches, greater errors, double stars, another lens."""
