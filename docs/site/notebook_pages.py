"""A hook of MkDocs: each notebook of docs/notebooks becomes a page, its stored outputs included."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages: notebooks/NAME.md from notebooks/NAME.ipynb."""
    for path in sorted(Path(config.docs_dir, "notebooks").glob("*.ipynb")):
        files.append(
            File.generated(
                config, f"notebooks/{path.stem}.md", content=notebook_markdown(path)
            )
        )
    return files


def notebook_markdown(path: Path) -> str:
    """A notebook as Markdown: text cells as they are, code in fences, outputs below their cell."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(
            source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```"
        )
        parts += [output_markdown(output) for output in cell.get("outputs", ())]
    parts.insert(1, f"[Download the notebook]({path.name})")
    return "\n\n".join(part for part in parts if part)


def output_markdown(output: dict[str, Any]) -> str:
    """One output: HTML, a picture or text."""
    data = output.get("data", {})
    if "text/html" in data:
        return f'<div class="output">{"".join(data["text/html"]).strip()}</div>'
    if "image/png" in data:
        return f'<img alt="output" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    text = "".join(output.get("text") or data.get("text/plain", ""))
    return f"```text\n{text.rstrip()}\n```" if text else ""
