"""Folders of the scenes and the data that come with skysim."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# An installed package carries within it what stands beside it in a checkout.
SHIPPED = ROOT if (ROOT / "pyproject.toml").is_file() else ROOT / "skysim"
DATA = SHIPPED / "data"
SCENES = SHIPPED / "scenes"
CATALOGUES = DATA / "catalogues"
