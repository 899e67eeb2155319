"""Errors of the estimator."""

from __future__ import annotations


class ImageError(ValueError):
    """The image or the calibration cannot be used. The one-line message names the fault and what is allowed."""
