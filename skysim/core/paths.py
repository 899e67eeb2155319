"""Folders of the scenes and the data that are shipped with skysim, and the titles of scene and study files.

Commands that only list files need these and no library: the module imports neither NumPy nor OpenCV.
"""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]

# In a checkout scenes/ and data/ are beside the package; an installed package contains them.
SHIPPED = ROOT if (ROOT / "pyproject.toml").is_file() else ROOT / "skysim"
DATA = SHIPPED / "data"
SCENES = SHIPPED / "scenes"
STUDIES = SCENES / "studies"
PAPERS = SCENES / "papers"  # scenes and studies of the papers' experiments
CATALOGS = DATA / "catalogs"


def shipped_files(folder: Path) -> dict[str, Path]:
    """YAML files of a folder by name; those of scenes and of studies include the papers'."""
    papers = {SCENES: PAPERS, STUDIES: PAPERS / "studies"}
    folders = [folder, papers[folder]] if folder in papers else [folder]
    files = {path.stem: path for one in folders for path in one.glob("*.yaml")}
    return dict(sorted(files.items()))


def title_of(path: Path) -> str:
    """Title of a scene or study file, or that of its base if it has none; "" if none can be read.

    Only the lines of these keys are parsed: a list of all scenes would otherwise take a second.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = dict(re.findall(r"^(title|base):(.*)", text, re.MULTILINE))
    try:
        values = {key: str(yaml.safe_load(text) or "") for key, text in lines.items()}
    except yaml.YAMLError:
        return ""
    if "title" in values:
        return values["title"]
    base = path.with_name(f"{values.get('base', '').removesuffix('.yaml')}.yaml")
    return title_of(base) if "base" in values and base.is_file() and base != path else ""
