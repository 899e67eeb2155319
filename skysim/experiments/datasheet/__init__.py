"""The datasheet of a star tracker: its error terms, performance, limits and robustness, each by its own experiment."""
