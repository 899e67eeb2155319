"""The report of a study: figures, their layout, the page and exports."""
