"""A star tracker: from a frame alone to an attitude, or an honest refusal."""


class BadImage(ValueError):
    """The image or the calibration cannot be used. The message is one line: what, and what is allowed."""
