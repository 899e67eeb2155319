"""The star tracker on board: build the estimator of a scene with the hardware parameters that it assumes."""
