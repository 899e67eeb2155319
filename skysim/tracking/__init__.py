"""The star tracker on board: build a scene's estimator with the hardware parameters that it assumes."""
