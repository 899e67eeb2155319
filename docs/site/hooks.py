"""What the site needs beyond Markdown: equations as MathML, and what pages link to outside of docs/.

Pages are written so that a code host shows them too: equations in ```math fences or $`x`$, links relative to the file.
"""

from __future__ import annotations

import html
import os
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\(([^)#\s:]+)(#[^)\s]*)?\)")
BLOCK = re.compile(r'<div class="math">(.*?)</div>', re.DOTALL)
INLINE = re.compile(r"\$<code>(.*?)</code>\$", re.DOTALL)
LANGUAGES = {".py": "python", ".yaml": "yaml", ".xml": "xml", ".json": "json", ".csv": "text"}

pages: dict[str, str] = {}  # where a page of Markdown lies in the repository, by its place in the site


def on_files(files: Any, config: Any) -> Any:
    """Whatever a page links to outside of docs/ becomes a page: Markdown as it is, a file's text, a folder's list."""
    pages.clear()
    pages.update({file.src_uri: f"docs/{file.src_uri}" for file in files.documentation_pages()})
    waiting = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *pages.values()]
    seen = set(pages.values())
    while waiting:
        path = waiting.pop()
        if path not in seen:
            seen.add(path)
            files.append(File.generated(config, place(path), content=text_of(path)))
            if (ROOT / path).suffix == ".md":
                pages[place(path)] = path
        if (ROOT / path).suffix == ".md":
            waiting += [there for there in links(path) if there not in seen and not in_site(there)]
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links as they are in the repository become links in the site."""
    here = pages.get(page.file.src_uri)
    if here is None:
        return markdown

    def moved(found: re.Match[str]) -> str:
        there = target(here, found[1])
        if there is None:
            return found[0]
        return f"]({os.path.relpath(place(there), os.path.dirname(page.file.src_uri))}{found[2] or ''})"

    return LINK.sub(moved, markdown)


def on_page_content(html_text: str, **_: Any) -> str:
    """LaTeX becomes MathML, which browsers draw without a script."""
    html_text = BLOCK.sub(lambda found: mathml(found[1], "block"), html_text)
    return INLINE.sub(lambda found: mathml(found[1], "inline"), html_text)


def mathml(escaped: str, display: str) -> str:
    """One equation, as Markdown left it in HTML."""
    return convert(html.unescape(escaped).strip(), display=display)


def links(path: str) -> list[str]:
    """What a page links to in the repository."""
    text = (ROOT / path).read_text(encoding="utf-8")
    found = [target(path, link[1]) for link in LINK.finditer(text)]
    return [there for there in found if there is not None]


def target(here: str, link: str) -> str | None:
    """A link's file or folder as a path in the repository; None where it is none."""
    there = os.path.normpath(os.path.join(os.path.dirname(here), link))
    return there if not there.startswith("..") and (ROOT / there).exists() else None


def in_site(path: str) -> bool:
    """Whether the site has a file as it is."""
    return path.startswith("docs/") and not path.endswith(".py")


def place(path: str) -> str:
    """Where a file of the repository is in the site."""
    if in_site(path):
        return path.removeprefix("docs/")
    if (ROOT / path).is_dir():
        return f"source/{path}/index.md"
    return f"source/{path}" if path.endswith(".md") else f"source/{path}.md"


def text_of(path: str) -> str:
    """The page of something outside of docs/."""
    there = ROOT / path
    if path.endswith(".md"):
        return there.read_text(encoding="utf-8")
    head = f"---\nsearch: {{exclude: true}}\ntitle: {there.name}\n---\n# `{path}`\n\n"
    if there.is_dir():
        return head + "\n".join(
            f"- `{name}`" for name in sorted(part.name for part in there.iterdir() if part.suffix)
        )
    return f"{head}`````{LANGUAGES.get(there.suffix, 'text')}\n{there.read_text(encoding='utf-8')}\n`````\n"
