"""Frame to blobs: background, thresholding, connected components, and what is a star."""
