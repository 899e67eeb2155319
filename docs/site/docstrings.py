"""Griffe extension: convert this project's docstrings to Markdown."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
from docstring_text import to_markdown


class Docstrings(griffe.Extension):
    """Rewrite every docstring before it is shown."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Called once an object has been read."""
        if obj.docstring is not None:
            obj.docstring = griffe.Docstring(to_markdown(obj.docstring.value), parent=obj)
