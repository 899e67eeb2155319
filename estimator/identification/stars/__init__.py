"""Identification of stars: search for candidate attitudes and their Bayes factor."""
