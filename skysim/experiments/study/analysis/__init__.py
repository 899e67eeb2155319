"""Answers from a study's rows: tables, sensitivity (error budget) and the search for the best design."""
