"""Folders of the scenes and the data that are shipped with skysim."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# In a checkout scenes/ and data/ are beside the package; an installed package contains them.
SHIPPED = ROOT if (ROOT / "pyproject.toml").is_file() else ROOT / "skysim"
DATA = SHIPPED / "data"
SCENES = SHIPPED / "scenes"
CATALOGS = DATA / "catalogs"
