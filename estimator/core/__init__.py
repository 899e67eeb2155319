"""Array types, errors, the camera model, vectors and least squares. Imports nothing else of the estimator."""
