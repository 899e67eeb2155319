"""Parts of the reference that are made from the code when the site is built.

A page marks the place of a part with a line `<!-- generated: NAME -->`.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import commands
import keys
import study_responses

MARKER = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
PARTS = {
    "commands": commands.commands_markdown,
    "scene_keys": keys.scene_keys,
    "study_keys": keys.study_keys,
    "proportions": study_responses.proportions,
    "quantities": study_responses.quantities,
    "statistics": study_responses.statistics,
}


def insert_parts(markdown: str) -> str:
    """Replace every marker of a page with its part. Raises KeyError for a part that does not exist."""
    return MARKER.sub(lambda marker: PARTS[marker[1]](), markdown)
