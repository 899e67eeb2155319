"""Results of a flight: scores, metrics, reports and files."""
