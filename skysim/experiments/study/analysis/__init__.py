"""Analysis of a study's trials: tables, sensitivity (error budget) and design optimization."""
