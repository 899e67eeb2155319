"""Code blocks of a page of the documentation, and the commands among them."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from skysim.core.paths import ROOT

SKYSIM = [sys.executable, "-m", "skysim"]


def text(page: str) -> str:
    """A page by its path in the repository."""
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    """Its code blocks of a language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", text(page), re.DOTALL)


def yaml_block(page: str, key: str) -> str:
    """The one block of YAML that has this key at its top."""
    (block,) = [
        block for block in blocks(page, "yaml") if re.search(rf"^{key}:", block, re.MULTILINE)
    ]
    return block


def commands(page: str) -> list[list[str]]:
    """The skysim commands of its shell blocks; `make` is what runs this test."""
    lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
    return [
        shlex.split(line, comments=True)[1:]
        for line in lines
        if line.startswith(".venv/bin/skysim")
    ]


def checkout(folder: Path) -> Path:
    """The folder, with scenes and data like the checkout."""
    for name in ("scenes", "data"):
        (folder / name).symlink_to(ROOT / name)
    return folder


def run_commands(page: str, folder: Path) -> None:
    """Run every command of a page in a folder; each must succeed and print something."""
    assert commands(page)
    for command in commands(page):
        done = subprocess.run([*SKYSIM, *command], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        assert done.stdout, command


def answer(folder: Path, *words: str) -> Any:
    """JSON printed by a command with --json."""
    done = subprocess.run(
        [*SKYSIM, *words, "--json"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def missing_links(page: str) -> list[str]:
    """Links of a page without a target."""
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text(page))
    assert links
    return [link for link in links if not (ROOT / page).parent.joinpath(link).exists()]
