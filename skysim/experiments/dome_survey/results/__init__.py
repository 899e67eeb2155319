"""What a survey has found: coverage, faults, statistics, pictures, and the page of its report."""
