"""The star tracker on board: builds the estimator from a scene, with what it believes of its hardware."""
