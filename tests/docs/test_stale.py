"""A findings page is stale if code that it depends on has changed, and only then."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from skysim.core.paths import ROOT

sys.path.insert(0, str(ROOT / "docs" / "site"))
import stale

SOURCE = '''"""Stars."""

from skysim.core.units import Length

LIMIT = 6.5  # magnitudes


def flux(magnitude):
    """Photons."""
    return 10 ** (-0.4 * (magnitude - LIMIT))
'''


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with a package, a study file and a page that depends on both."""
    monkeypatch.setattr(stale, "ROOT", tmp_path)
    monkeypatch.setattr(stale, "FINDINGS", tmp_path / "docs" / "findings")
    write(tmp_path, "skysim/sources/stars.py", SOURCE)
    write(tmp_path, "skysim/sources/planets.py", "RADIUS = 1\n")
    write(tmp_path, "study.yaml", "seed: 3  # any\n")
    made = stale.make_stamp(["skysim.sources", "study.yaml"], 3, "2026-11-20")
    write(
        tmp_path,
        "docs/findings/page.md",
        f"# Page\n\n```sh\nskysim study run page\n```\n\n{made.line}\n",
    )
    return tmp_path


def write(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


STALE = [
    "docs/findings/page.md: code changed since 2026-11-20; again: skysim study run page",
]


def test_a_page_is_fresh_when_it_is_made(tree: Path) -> None:
    assert stale.stale_lines() == []


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("skysim/sources/stars.py", "LIMIT = 6.5", "LIMIT = 6.6"),
        ("skysim/sources/stars.py", "-0.4 *", "0.4 *"),
        ("study.yaml", "seed: 3", "seed: 4"),
    ],
)
def test_a_changed_constant_operator_or_key_makes_it_stale(
    tree: Path, name: str, old: str, new: str
) -> None:
    text = (tree / name).read_text(encoding="utf-8")
    write(tree, name, text.replace(old, new))
    assert stale.stale_lines() == STALE


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("skysim/sources/stars.py", "# magnitudes", "# V magnitudes"),
        ("skysim/sources/stars.py", "Photons", "Photons per second"),
        ("skysim/sources/stars.py", "    return 10 ** (", "    return 10 ** (\n        "),
        ("skysim/sources/stars.py", "skysim.core.units", "skysim.core.quantities"),
        ("study.yaml", "# any", "# another comment"),
    ],
)
def test_comments_docstrings_layout_and_moved_imports_leave_it_fresh(
    tree: Path, name: str, old: str, new: str
) -> None:
    text = (tree / name).read_text(encoding="utf-8")
    assert old in text
    write(tree, name, text.replace(old, new))
    assert stale.stale_lines() == []


def test_a_function_that_moves_within_its_package_leaves_it_fresh(tree: Path) -> None:
    (tree / "skysim/sources/stars.py").unlink()
    write(tree, "skysim/sources/planets.py", SOURCE + "\n\nRADIUS = 1\n")
    assert stale.stale_lines() == []


def test_a_package_that_is_gone_makes_it_stale(tree: Path) -> None:
    for path in (tree / "skysim/sources").glob("*.py"):
        path.unlink()
    assert stale.stale_lines() == STALE


def test_a_page_that_is_stamped_again_is_fresh(tree: Path) -> None:
    write(tree, "skysim/sources/stars.py", "LIMIT = 7\n")
    stale.main(["--stamp", str(tree / "docs/findings/page.md")])
    assert stale.stale_lines() == []


PAGES = sorted((ROOT / "docs" / "findings").rglob("*.md"))
OVERVIEWS = {"studies.md"}  # list other pages and have no figures of their own


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_findings_page_says_of_which_code_it_is(path: Path) -> None:
    if path.name in OVERVIEWS:
        return
    stamp = stale.read_stamp(path.read_text(encoding="utf-8"))
    for name in stamp.needs:
        assert stale.working_tree(name), f"{name} does not exist"


def test_findings_stay_short() -> None:
    """A page is read in five minutes, and all of them within an hour and a half."""
    words = {path: len(path.read_text(encoding="utf-8").split()) for path in PAGES}
    assert max(words.values()) <= 2_600
    assert sum(words.values()) <= 16_000


def test_every_picture_is_shown() -> None:
    shown = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md")
    )
    named = set(re.findall(r"[\w-]+\.png", shown))
    assert [
        path.name
        for path in (ROOT / "docs" / "findings").rglob("*.png")
        if path.name not in named
    ] == []
