"""Messages of the command line in words of the page, which has no options."""

from __future__ import annotations

import re

REPLACED = (  # in this order
    (r" \(--set\)", ""),
    (r", or another --out\b", ", or a study of another name"),
    (r"\banother --out\b", "a study of another name"),
    (r"; allowed: skysim study resume, ", "; allowed: "),
    (r"--fov\b", "the field of view"),
    (r"--date\b", "the date"),
    (r"--set ", ""),
    (r"--([a-z])", r"\1"),  # of any other option its word
)


def for_page(message: str) -> str:
    """A message without the options of the command line."""
    for pattern, words in REPLACED:
        message = re.sub(pattern, words, message)
    return message
