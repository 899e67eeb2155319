"""Titles of scene and study files, read without the rest of the file."""

from pathlib import Path

import pytest

from skysim.core.paths import title_of


@pytest.mark.parametrize(
    ("text", "title"),
    [
        ("schema: 1\ntitle: A dome, tilted\n", "A dome, tilted"),
        ('title: "A dome: tilted"   # two words\n', "A dome: tilted"),
        ("base: lab\nlight: {title: no}\n", "The lab"),
        ("base: lab.yaml\n", "The lab"),
        ("base: lab\ntitle: My lab\n", "My lab"),
        ("base: elsewhere\n", ""),
        ("light:\n  title: within a section\n", ""),
        ('title: "open\n', ""),
    ],
)
def test_a_title_is_taken_from_the_file_or_its_base(
    tmp_path: Path, text: str, title: str
) -> None:
    (tmp_path / "lab.yaml").write_text("title: The lab\n")
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    assert title_of(path) == title
