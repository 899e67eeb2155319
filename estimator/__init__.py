"""A star tracker: from a frame alone to an attitude, or an honest refusal."""
