"""Many simulations, one answer: studies, the papers' experiments, the dome survey, tracker comparisons."""
