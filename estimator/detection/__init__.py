"""Frame to blobs: background, thresholding, connected components, and blob classification."""
