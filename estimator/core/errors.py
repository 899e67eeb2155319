"""Errors of the estimator."""

from __future__ import annotations


class ImageError(ValueError):
    """The image or the calibration cannot be used. The message is one line: what, and what is allowed."""
