"""Centroids to catalog entries: search for candidate attitudes, and the evidence for each."""
