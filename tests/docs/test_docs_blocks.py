"""Every code block of README and docs is run: here, page by page and in its order, or by the test that is named here.

On a page `sh` lines are commands, each run as a reader would; `yaml` and `python` whose first line is a comment with a
file's name are that file; other `python` runs, all of a page in one session. A `text` block is not run: after a command
it is what the command prints, numbers aside.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from skysim.apps.cli import main
from skysim.core.paths import ROOT

DOCS = ROOT / "docs"
ELSEWHERE = {  # pages whose blocks have a test of their own, which knows what is to come out
    "README.md": "docs/test_readme.py",
    "docs/howto/run.md": "docs/test_howto_run.py",
    "docs/howto/scene.md": "docs/test_howto_scene.py",
    "docs/howto/study.md": "docs/test_howto_study.py",
    "docs/findings/dome.md": "docs/test_docs.py",
    "docs/howto/export.md": "docs/test_formats.py",
    "docs/howto/external_tracker.md": "tracking/test_interface.py",
    "docs/howto/light.md": "simulation/test_lights.py",
    "docs/howto/live.md": "apps/live/test_clients.py",
    "docs/howto/protocols.md": "apps/live/test_clients.py",
    "docs/findings/papers.md": "experiments/papers/test_reproduction.py",
    "docs/findings/studies.md": "docs/test_docs.py",
    "estimator/README.md": "docs/test_estimator_readme.py",
}
LONG = {
    "tutorial.md",
    "findings/validation.md",
    "howto/build_a_dome.md",
    "howto/camera.md",
    "howto/datasheet.md",
    "howto/cluster.md",
    "howto/dome.md",
    "howto/photo.md",
    "howto/profile.md",
    "howto/ptase_session.md",
    "howto/thesis_tests.md",
    "howto/tracker.md",
    "explanation/error_budget.md",
}
# Of the extras that `make test-slow` installs.
NEEDS = {"howto/query_results.md": "duckdb", "howto/simulink.md": "fmpy"}
# All that a page may have; the last five are not run.
LANGUAGES = {"sh", "python", "yaml", "toml", "json", "text", "math", "c"}
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"# ([\w.]+\.(?:py|yaml))\n")
NUMBER = re.compile(r"[-+−]?\d[\d.,e+]*")


class Block(NamedTuple):
    """A code block: its language and text."""

    language: str
    text: str


def blocks(path: Path) -> list[Block]:
    return [Block(*found) for found in FENCE.findall(path.read_text(encoding="utf-8"))]


def all_pages() -> list[Path]:
    return [
        ROOT / "README.md",
        ROOT / "estimator/README.md",
        ROOT / "CONTRIBUTING.md",
        *sorted(DOCS.rglob("*.md")),
    ]


def walked() -> list[Any]:
    """Pages with blocks to run and without a test of their own."""
    pages = [
        path for path in all_pages() if path.relative_to(ROOT).as_posix() not in ELSEWHERE
    ]
    running = [
        path
        for path in pages
        if {"sh", "python", "yaml"} & {block.language for block in blocks(path)}
    ]
    names = [os.path.relpath(path, DOCS) for path in running if "studies" not in path.parts]
    return [
        pytest.param(name, marks=[pytest.mark.long] if name in LONG else []) for name in names
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A folder like the checkout, as the working directory."""
    for name in ("scenes", "data"):
        (tmp_path / name).symlink_to(ROOT / name)
    with contextlib.chdir(tmp_path):
        yield tmp_path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # a reader sees them too
@pytest.mark.parametrize("name", walked())
def test_a_page_s_blocks_run_in_order(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.setenv(
        "PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    )
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    session: dict[str, Any] = {}
    printed = ""
    files = []
    for block in blocks(DOCS / name):
        named = FILE.match(block.text)
        if block.language in ("yaml", "python") and named:
            Path(named[1]).write_text(block.text, encoding="utf-8")
            files.append(named[1])
        elif block.language == "yaml":
            pytest.fail(
                f"a block of YAML without a file's name in its first line:\n{block.text}"
            )
        elif block.language == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(block.text, name, "exec"), session)
        elif block.language == "sh":
            printed = "".join(ran(line) for line in block.text.splitlines() if line)
        elif block.language == "text" and printed:
            printed_shapes = {shape(line) for line in printed.splitlines()}
            assert [
                line for line in block.text.splitlines() if shape(line) not in printed_shapes
            ] == [], printed
        if block.language != "sh":
            printed = ""
    commands = "\n".join(
        block.text for block in blocks(DOCS / name) if block.language in ("sh", "yaml")
    )
    assert [
        file
        for file in files
        if len(re.findall(rf"\b{file}\b", commands)) < (1 + file.endswith(".yaml"))
    ] == []


def ran(line: str) -> str:
    """Text printed by a command. `make` runs this test itself, so only its targets are checked."""
    program, *words = shlex.split(line, comments=True)
    if program == "make":
        done = subprocess.run(
            ["make", "-n", *words], cwd=ROOT, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return ""
    assert program == "skysim", f"{line}: another program's command belongs in a `text` block"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert not main.app(words, standalone_mode=False), line
    assert printed.getvalue(), line
    assert "failed:" not in printed.getvalue(), line
    if words[0] == "run":
        assert re.search(
            r"^[1-9]\d* of \d+ frames solved, 0 wrong", printed.getvalue(), re.M
        ), printed.getvalue()
    return printed.getvalue()


def shape(line: str) -> str:
    """A printed line with its numbers and its spacing left out."""
    return "".join(NUMBER.sub("#", line).split())


@pytest.mark.parametrize(
    "path", all_pages(), ids=lambda path: path.relative_to(ROOT).as_posix()
)
def test_every_block_states_its_language(path: Path) -> None:
    """Blocks that are not run are `text` blocks; unknown languages are refused."""
    assert [block for block in blocks(path) if block.language not in LANGUAGES] == []
    assert path.read_text(encoding="utf-8").count("```") == 2 * len(blocks(path)) + 0


def test_a_page_run_by_another_test_is_read_by_it() -> None:
    for page, test in ELSEWHERE.items():
        assert page in (ROOT / "tests" / test).read_text(encoding="utf-8"), page


def test_the_study_pages_show_existing_commands() -> None:
    """Written by `make studies`, one command each."""
    for path in sorted((DOCS / "findings/studies").glob("*.md")):
        (only,) = blocks(path)
        assert re.fullmatch(rf"skysim study (run|optimize) {path.stem}\n", only.text)


# --- the site ------------------------------------------------------------------------------------------------


def nav(part: Any) -> Iterator[str]:
    for entry in part if isinstance(part, list) else part.values():
        yield from [entry] if isinstance(entry, str) else nav(entry)


class Loader(yaml.SafeLoader):
    """Reader of mkdocs.yml that ignores its Python functions."""


Loader.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda *_: None)
SITE = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)


def test_every_page_is_in_the_site_s_navigation() -> None:
    there = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    there |= {
        path.relative_to(DOCS).with_suffix(".md").as_posix()
        for path in DOCS.glob("notebooks/*.ipynb")
    }
    outside = {name for name in nav(SITE["nav"]) if name.startswith("source/")}
    assert set(nav(SITE["nav"])) - outside == there
    assert all((ROOT / name.removeprefix("source/")).is_file() for name in outside)


def test_every_name_in_the_reference_is_a_module() -> None:
    named = [
        name
        for path in (DOCS / "reference").glob("*.md")
        for name in re.findall(r"^::: (\S+)$", path.read_text(), re.M)
    ]
    assert len(named) > 40
    files = [ROOT / name.replace(".", "/") for name in named]
    assert [
        path
        for path in files
        if not (path.with_suffix(".py").is_file() or (path / "__init__.py").is_file())
    ] == []


def test_the_reference_holds_every_module_that_a_page_names() -> None:
    """Modules that a reader imports or is referred to, except the browser lab and the papers."""
    text = "".join(path.read_text(encoding="utf-8") for path in all_pages())
    files = re.findall(r"(?<!tests/)\b((?:skysim|estimator)/[\w/]+)\.py", text)
    for package, name in re.findall(
        r"^from ((?:skysim|estimator)\.[\w.]+) import (\w+)", text, re.M
    ):
        folder = package.replace(".", "/")
        there = (ROOT / folder / f"{name}.py").is_file() or (
            ROOT / folder / name / "__init__.py"
        ).is_file()
        files.append(f"{folder}/{name}" if there else folder)
    named = {name.replace("/", ".") for name in files}
    named = {
        name
        for name in named
        if not name.startswith(
            ("skysim.apps.gui.", "skysim.apps.cli.", "skysim.experiments.papers.")
        )
    }
    reference = "".join(
        path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md")
    )
    assert len(named) > 40
    assert sorted(named - set(re.findall(r"^::: (\S+)$", reference, re.M))) == []


def test_every_link_of_a_page_has_an_existing_target() -> None:
    for path in DOCS.rglob("*.md"):
        links = re.findall(r"\]\(([^)#\s:]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
        assert [link for link in links if not (path.parent / link).exists()] == [], path


@pytest.mark.long
def test_the_figures_are_drawn_by_their_script(tmp_path: Path) -> None:
    script = DOCS / "site/figures.py"
    subprocess.run(
        [sys.executable, script, tmp_path],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        check=True,
    )
    drawn = {path.name for path in tmp_path.glob("*.svg")}
    assert drawn == {path.name for path in (DOCS / "images").glob("*.svg")}
    text = "".join(path.read_text(encoding="utf-8") for path in DOCS.rglob("*.md"))
    assert [name for name in drawn if f"images/{name}" not in text] == []
