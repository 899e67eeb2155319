"""What a run leaves and what it means: metrics, scores, reports and files."""
