"""Write docs/findings/datasheets/shefex2.md, the example of a datasheet, from the page that the command writes.

`skysim datasheet shefex2 --fields 300 --markdown out/shefex2.md; python docs/site/datasheets.py out/shefex2.md`.
The example has the first sections; the others are named.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from stale import make_stamp
from studies import NEEDS

PAGE = Path(__file__).parents[1] / "findings" / "datasheets" / "shefex2.md"
KEPT = (
    "Error terms",
    "What dominates, and what would lower it",
    "Right, refused and false attitudes",
    "Performance at a confidence",
    "By rate",
)
OPENING = """# What does a datasheet say? An example

{answer}

The page is an extract of what the command writes, with terms in the sense of ECSS-E-ST-60-20C (star sensors:
terminology and performance specification). The numbers are of the simulated scene; compliance with the standard is not
claimed. The full page also has the sections {others}.

```text
skysim datasheet shefex2 --fields 300
```
"""
ANSWER = (
    "The simulated tracker of `shefex2` errs by {across}″ across the boresight and {about}″ about it (one axis, 1 σ)."
    " Most of it is temporal noise: {across_noise} % of the variance across and {about_noise} % about."
    " Lost in space at rest, {right} of the attitudes are right."
)


def extract(text: str, stamp: str) -> str:
    """The example page. text : the page that the command wrote"""
    _, *parts = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)
    sections = dict(zip(parts[::2], parts[1::2], strict=True))
    others = ", ".join(f"*{title}*" for title in sections if title not in KEPT)
    kept = "\n".join(f"## {title}\n{sections[title].rstrip()}\n" for title in KEPT)
    return f"{OPENING.format(answer=answer(sections), others=others)}\n{kept}\n{stamp}\n"


def answer(sections: dict[str, str]) -> str:
    """Three sentences with the numbers of the table of error terms and of the shares."""

    def row(name: str) -> list[str]:
        (line,) = re.findall(rf"^\| {name} \|(.*)$", sections[KEPT[0]], re.MULTILINE)
        return [cell.split(" (")[0].strip() for cell in line.split("|")]

    across, _, about, *_ = row("sum")
    _, across_noise, _, about_noise, *_ = row("temporal noise")
    (right,) = re.findall(r"right ([\d.]+ \([^)]*\) %)", sections[KEPT[2]])
    return ANSWER.format(
        across=across,
        about=about,
        across_noise=across_noise,
        about_noise=about_noise,
        right=right,
    )


def main(path: Path) -> None:
    """Write the page."""
    stamp = make_stamp([*NEEDS, "scenes/shefex2.yaml"], 1)
    PAGE.write_text(extract(path.read_text(encoding="utf-8"), stamp.line), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
