"""Blobs to centroids: moments and fits of Gaussians, streaks and disks."""
