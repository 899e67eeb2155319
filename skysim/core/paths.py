"""Folders of the scenes and the data that are shipped with skysim, and the titles of scene and study files."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]

# In a checkout scenes/ and data/ are beside the package; an installed package contains them.
SHIPPED = ROOT if (ROOT / "pyproject.toml").is_file() else ROOT / "skysim"
DATA = SHIPPED / "data"
SCENES = SHIPPED / "scenes"
STUDIES = SCENES / "studies"
CATALOGS = DATA / "catalogs"


def title_of(path: Path) -> str:
    """Title of a scene or study file, or of the base of a scene without one; "" if there is none.

    Only its line is parsed: a list of all scenes would otherwise take a second.
    """
    lines = dict(re.findall(r"^(title|base):(.*)", path.read_text(encoding="utf-8"), re.MULTILINE))
    if "title" in lines:
        return str(yaml.safe_load(lines["title"]) or "")
    base = path.with_name(f"{str(yaml.safe_load(lines.get('base', '')) or '').removesuffix('.yaml')}.yaml")
    return title_of(base) if "base" in lines and base.is_file() else ""
