"""Results of a run: metrics, scores, reports and files."""
