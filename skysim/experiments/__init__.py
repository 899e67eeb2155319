"""Experiments of many simulations: studies, the papers' experiments, dome survey, tracker comparison."""
