"""MkDocs hook: equations as MathML, the generated reference, pages for files outside of docs/ that pages link to.

Pages are written so that a code host shows them too: equations in ```math fences or $`x`$, links relative to the file.
"""

from __future__ import annotations

import html
import os
import re
import sys
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

sys.path.insert(0, str(Path(__file__).parent))
import reference

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\(([^)#\s:]+)(#[^)\s]*)?\)")
BLOCK = re.compile(r'<div class="math">(.*?)</div>', re.DOTALL)
INLINE = re.compile(r"\$<code>(.*?)</code>\$", re.DOTALL)
LANGUAGES = {".py": "python", ".yaml": "yaml", ".xml": "xml", ".json": "json", ".csv": "text"}

# Path in the repository of each Markdown page, by its path in the site.
repository_paths: dict[str, str] = {}


def on_files(files: Any, config: Any) -> Any:
    """Add a page for every linked file or folder outside of docs/: its Markdown, its text or its list of files."""
    repository_paths.clear()
    repository_paths.update(
        {file.src_uri: f"docs/{file.src_uri}" for file in files.documentation_pages()}
    )
    queue = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *repository_paths.values()]
    visited = set(repository_paths.values())
    while queue:
        path = queue.pop()
        if path not in visited:
            visited.add(path)
            files.append(File.generated(config, site_path(path), content=page_text(path)))
            if (ROOT / path).suffix == ".md":
                repository_paths[site_path(path)] = path
        if (ROOT / path).suffix == ".md":
            queue += [
                linked
                for linked in linked_paths(path)
                if linked not in visited and not in_site(linked)
            ]
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert the generated parts, and rewrite links within the repository as links within the site."""
    markdown = reference.insert_parts(markdown)
    page_path = repository_paths.get(page.file.src_uri)
    if page_path is None:
        return markdown

    def rewrite_link(match: re.Match[str]) -> str:
        linked = link_target(page_path, match[1])
        if linked is None:
            return match[0]
        return f"]({os.path.relpath(site_path(linked), os.path.dirname(page.file.src_uri))}{match[2] or ''})"

    return LINK.sub(rewrite_link, markdown)


def on_page_content(html_text: str, **_: Any) -> str:
    """Convert LaTeX to MathML, which browsers draw without a script."""
    html_text = BLOCK.sub(lambda match: mathml(match[1], "block"), html_text)
    return INLINE.sub(lambda match: mathml(match[1], "inline"), html_text)


def mathml(escaped: str, display: str) -> str:
    """MathML of one equation from its escaped LaTeX."""
    return convert(html.unescape(escaped).strip(), display=display)


def linked_paths(path: str) -> list[str]:
    """Paths in the repository that a page links to."""
    text = (ROOT / path).read_text(encoding="utf-8")
    targets = [link_target(path, link[1]) for link in LINK.finditer(text)]
    return [linked for linked in targets if linked is not None]


def link_target(page_path: str, link: str) -> str | None:
    """Path in the repository of a link's target; None if it does not exist there."""
    linked = os.path.normpath(os.path.join(os.path.dirname(page_path), link))
    return linked if not linked.startswith("..") and (ROOT / linked).exists() else None


def in_site(path: str) -> bool:
    """Return True if the site holds the file itself."""
    return path.startswith("docs/") and not path.endswith(".py")


def site_path(path: str) -> str:
    """Path in the site of a file of the repository."""
    if in_site(path):
        return path.removeprefix("docs/")
    if (ROOT / path).is_dir():
        return f"source/{path}/index.md"
    return f"source/{path}" if path.endswith(".md") else f"source/{path}.md"


def page_text(path: str) -> str:
    """Markdown text of the page for a file or folder outside of docs/."""
    source = ROOT / path
    if path.endswith(".md"):
        return source.read_text(encoding="utf-8")
    heading = f"---\nsearch: {{exclude: true}}\ntitle: {source.name}\n---\n# `{path}`\n\n"
    if source.is_dir():
        return heading + "\n".join(
            f"- `{name}`"
            for name in sorted(entry.name for entry in source.iterdir() if entry.suffix)
        )
    return f"{heading}`````{LANGUAGES.get(source.suffix, 'text')}\n{source.read_text(encoding='utf-8')}\n`````\n"
