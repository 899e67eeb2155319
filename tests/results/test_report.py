"""Laws of reports: text is kept and never interpreted, and every output format has the same content."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.results import report
from skysim.results.report import (
    Block,
    Cell,
    Code,
    Column,
    Facts,
    Figure,
    Items,
    Report,
    Section,
    Table,
    Text,
    Verdict,
)

HOSTILE = "<script>alert(1)</script> & \"quotes\" 'and' </td></table> <!-- -->"
PICTURE = cv2.imencode(".png", np.zeros((3, 4, 3), np.uint8))[1].tobytes()


def of(*blocks: Block) -> Report:
    return Report("a report", blocks, "skysim run x")


def everywhere(text: str) -> Report:
    """A report with the text in every place that accepts outside text."""
    table = Table(
        [Column(text), Column("note", kind="aside")],
        [[text, text], [Cell(text, "bad", 3.0), ""]],
    )
    blocks = [
        Verdict(text, "bad"),
        Text(text),
        Items([text], text, "warning"),
        Facts([(text, [text, Cell(text)])]),
    ]
    inner = Section(text, [table, Figure(PICTURE, text), Code(text)])
    return Report(
        text,
        [*blocks, Section(text, [inner]), Section(text, [Text(text)], folded=True)],
        text,
    )


class Parsed(HTMLParser):
    """Elements, texts and images of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.texts: list[tuple[str, str]] = []
        self.images: list[str] = []
        self.keys: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.append(tag)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if tag == "img":
            self.images.append(found["src"] or "")
        if "data-key" in found:
            self.keys.append(found["data-key"] or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))


def test_a_text_from_outside_is_text_in_html() -> None:
    page = Parsed(everywhere(HOSTILE).html())
    plain = Parsed(everywhere("plain").html())
    assert page.tags == plain.tags
    assert page.open == []
    shown = [text for tag, text in page.texts if text == HOSTILE]
    assert len(shown) == len([text for tag, text in plain.texts if text == "plain"])


def test_a_text_from_outside_opens_no_element_in_markdown() -> None:
    """Code is excepted, as Markdown shows it literally."""
    outside_of_code = re.sub(
        r"^(`{3,})\w*\n.*?^\1$",
        "",
        everywhere(HOSTILE).markdown(),
        flags=re.DOTALL | re.MULTILINE,
    )
    allowed = r"</?(details|summary|br)\b"
    assert re.sub(allowed, "", outside_of_code).count("alert") > 5
    assert not re.search(r"<[A-Za-z/!?]", re.sub(allowed, "", outside_of_code))


def test_code_that_contains_a_fence_is_fenced_longer() -> None:
    text = of(Code("```\n<b>\n````\nend")).markdown()
    fence = re.findall(r"^(`+)$", text, re.MULTILINE)[-1]
    assert len(fence) == 5
    assert text.rstrip().endswith(f"end\n{fence}")


def test_a_row_of_markdown_has_as_many_cells_as_its_head() -> None:
    table = Table([Column("a"), Column("b")], [["x | y", "z\nnext line"]])
    head, _, row = of(table).markdown().splitlines()[-3:]
    assert len(re.findall(r"(?<!\\)\|", row)) == len(re.findall(r"\|", head)) == 3


def test_backticks_are_code_in_html_and_letters_elsewhere(
    capsys: pytest.CaptureFixture[str],
) -> None:
    one = of(Text("set `tracker.map` to <b>`a<b`</b> or a lone ` mark"))
    page = Parsed(one.html())
    assert [text for tag, text in page.texts if tag == "code"] == [
        "skysim run x",
        "tracker.map",
        "a<b",
    ]
    assert "".join(text for tag, text in page.texts if tag == "p").endswith(
        "or a lone ` mark"
    )
    assert "`tracker.map`" in one.markdown()
    one.print()
    assert "`tracker.map`" in capsys.readouterr().out


def test_a_page_loads_nothing_from_outside() -> None:
    page = of(Figure(PICTURE, "a"), Figure(b"GIF89a", "b", "gif")).html()
    assert [one.partition(";")[0] for one in Parsed(page).images] == [
        "data:image/png",
        "data:image/gif",
    ]
    assert not re.search(
        r"https?:|//[a-z]|@import|url\(", re.sub(r"data:image/\w+;base64,[\w+/=]+", "", page)
    )


def test_a_number_has_its_columns_format_and_sorts_by_its_value() -> None:
    table = Table(
        [Column("error", "″", ".2f")],
        [[1.239], [None], [float("nan")], [7], ["text"], [Cell("b", key=2.5)]],
    )
    assert [row[0].text for row in table.cells()] == ["1.24", "–", "–", "7.00", "text", "b"]
    assert Parsed(of(table).html()).keys == ["1.239", "", "", "7", "2.5"]
    assert "| error ″ |" in of(table).markdown()


def test_json_holds_the_numbers_themselves(tmp_path: Path) -> None:
    table = Table([Column("error", "″", ".2f")], [[1.239], [None], [Cell("WRONG", "bad")]])
    path = of(Verdict("yes"), Section("s", [table, Figure(PICTURE, "seen")])).save(
        tmp_path / "report.json"
    )
    document = json.loads(path.read_text())
    assert (document["title"], document["command"]) == ("a report", "skysim run x")
    verdict, section = document["blocks"]
    assert verdict == {"kind": "verdict", "text": "yes", "tone": ""}
    assert section["blocks"][0]["columns"] == [{"title": "error", "unit": "″"}]
    assert section["blocks"][0]["rows"] == [[1.239], [None], ["WRONG"]]
    assert section["blocks"][1] == {"kind": "figure", "caption": "seen"}


def test_empty_blocks_are_left_out() -> None:
    nothing = [
        Text(""),
        Items([], "title"),
        Facts([]),
        Section("deep", [Section("deeper", [Text("")])]),
    ]
    assert of(*nothing).blocks == []
    assert "deep" not in of(*nothing, Text("something")).html()


def test_markdown_links_its_pictures_where_it_writes_them(tmp_path: Path) -> None:
    one = of(
        Figure(PICTURE, "first [1]", name="named"),
        Section("s", [Figure(PICTURE, "second", "jpeg")]),
    )
    for pictures, folder in (("", "page/"), ("page_", "page_")):
        path = one.save(tmp_path / "page.md", pictures)
        linked = re.findall(r"^!\[[^]]*\]\((.+)\)$", path.read_text(), re.MULTILINE)
        assert linked == [f"{folder}named.png", f"{folder}2.jpeg"]
        assert all((tmp_path / name).read_bytes() == PICTURE for name in linked)
    assert "![" not in one.markdown()


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"unknown file format '.pdf'; allowed: .html, .md, .json"
    ):
        of().save(tmp_path / "report.pdf")
    (tmp_path / "page.md").mkdir()
    with pytest.raises(InputError, match=r"page.md: is a folder; allowed: a file"):
        of().save(tmp_path / "page.md")


def test_the_terminal_ends_with_the_answer_and_shows_only_its_blocks(
    capsys: pytest.CaptureFixture[str],
) -> None:
    aside = Table(
        [Column("what", kind="text"), Column("note", kind="aside")], [["row", "why so"]]
    )
    hidden = Section("hidden", [Text("page alone")], on_terminal=False)
    of(
        Verdict("the answer"),
        hidden,
        Section("shown", [aside]),
        Section("drawn", [Figure(PICTURE, "c")]),
    ).print()
    lines = capsys.readouterr().out.splitlines()
    assert [line.strip() for line in lines if line.strip()] == [
        "shown",
        "what",
        "row",
        "row: why so",
        "the answer",
    ]


def test_a_long_table_is_cut_on_the_terminal_with_a_note(
    capsys: pytest.CaptureFixture[str],
) -> None:
    report.print_table(Table([Column("n")], [[n] for n in range(100)]))
    *_, last, more = capsys.readouterr().out.splitlines()
    assert int(last) == report.MAX_ROWS - 1
    assert more == f"and {100 - report.MAX_ROWS} more rows in the report"


@pytest.mark.parametrize(
    ("width", "count"),
    [(80, 6), (73, 6), (72, 5), (60, 5), (59, 4), (42, 4), (41, 3), (10, 3)],
)
def test_a_narrow_terminal_leaves_out_optional_columns_alone(
    width: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Columns of 5, 4, 11, 16, 16 and 11 characters, two between each: 24 without optional ones, 42, 60, 73 in all."""
    monkeypatch.setattr(report, "terminal_width", lambda: width)
    heads = ["point", "leds", "placement", "identified", "coverage", "stars_least"]
    rows = [
        ["0", "200", "poisson", "0.5 (0.45..0.55)", "0.9 (0.85..0.95)", "3"],
        ["1", "2800", "a long name", "1", "1", "4"],
    ]
    table = Table([Column(head) for head in heads], rows, [(5,), (4,), (3,)])
    assert report.fitting_columns(table, table.cells()) == list(range(count))
