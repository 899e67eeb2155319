"""Gores on pages: a sheet shows what its neighbor ends with, and a hundred millimeters are a hundred millimeters."""

from __future__ import annotations

import re
import zlib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.results.files import templates
from skysim.results.files.templates import (
    HEAD_MM,
    MARGIN_MM,
    OVERLAP_MM,
    PAPERS,
    Circle,
    Page,
    Polyline,
    pages,
    write_pdf,
)
from skysim.sources.dome.surface import Ellipsoid

RADIUS_M = 1.2
# LEDs near the apex, in the middle and at the rim.
TILT_RAD = np.radians([3.0, 20.0, 31.0])
LED_M = RADIUS_M * np.column_stack([np.sin(TILT_RAD), 0 * TILT_RAD, np.cos(TILT_RAD)])
DOME: Any = SimpleNamespace(
    name="mine",
    surface=Ellipsoid(np.zeros(3), np.full(3, RADIUS_M)),
    cap_deg=32.0,
    leds=SimpleNamespace(id=np.array([7, 8, 9]), xyz=LED_M),
    light=SimpleNamespace(led=SimpleNamespace(disk_diameter_m=2e-3)),
)
POINT_MM = 25.4 / 72


def shown_mm(page: Page) -> np.ndarray:
    """(2, 2) upper left and lower right corner of what a page shows, on the gore."""
    corner = np.array(page.corner_mm)
    size = [page.width_mm - 2 * MARGIN_MM, page.height_mm - 2 * MARGIN_MM - HEAD_MM]
    return np.array([corner, corner + size])


@pytest.mark.parametrize("paper", ["a4", "a3"])
def test_sheets_cover_a_gore_and_share_a_strip_with_two_marks(paper: str) -> None:
    first = [page for page in pages(DOME, paper) if ": gore 1 of" in page.title]
    (outline,) = (
        shape.xy_mm
        for shape in first[0].shapes
        if isinstance(shape, Polyline) and shape.closed
    )
    windows = np.array([shown_mm(page) for page in first])
    assert outline[:, 0].min() > windows[:, 0, 0].max()
    assert outline[:, 0].max() < windows[:, 1, 0].min()
    assert windows[0, 0, 1] < outline[:, 1].min()
    assert windows[-1, 1, 1] > outline[:, 1].max()
    marks = [
        shape
        for shape in first[0].shapes
        if isinstance(shape, Circle) and shape.layer == "MARKS"
    ]
    for above, below in pairwise(windows):
        assert above[1, 1] - below[0, 1] == pytest.approx(OVERLAP_MM)
        shared = [one for one in marks if below[0, 1] < one.y_mm < above[1, 1]]
        assert len(shared) == 2


@pytest.mark.parametrize("paper", PAPERS)
def test_every_led_is_on_one_gore(paper: str) -> None:
    found = [
        tuple(shape.xy_mm[0])
        for page in pages(DOME, paper)
        for shape in page.shapes
        if isinstance(shape, Polyline) and shape.layer == "CENTERS"
        if (shown_mm(page)[0] <= shape.xy_mm[0]).all()
        and (shape.xy_mm[0] <= shown_mm(page)[1]).all()
    ]
    # A cross is two lines; one in a shared strip is on two sheets.
    assert len(set(found)) == 6


@pytest.mark.slow
@pytest.mark.parametrize(("paper", "size_mm"), [("a4", (210, 297)), ("a3", (297, 420))])
def test_the_pages_are_to_scale(paper: str, size_mm: tuple[int, int], tmp_path: Path) -> None:
    """Read back from the PDF's operators: page size, scale line, and the length of a gore, the arc of its meridian."""
    count = write_pdf(tmp_path / "gores.pdf", DOME, paper)
    data = (tmp_path / "gores.pdf").read_bytes()
    boxes = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", data)
    assert len(boxes) == count
    assert [float(side) * POINT_MM for side in boxes[0]] == pytest.approx(size_mm, abs=0.01)
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL)
    text = b"\n".join(unpacked for one in streams if (unpacked := inflated(one)))
    lines = re.findall(rb"([-\d.]+) ([-\d.]+) m\n([-\d.]+) ([-\d.]+) l\s+S", text)
    ends_mm = np.array(lines, float) * POINT_MM
    length_mm = np.hypot(*(ends_mm[:, :2] - ends_mm[:, 2:]).T)
    assert (np.abs(length_mm - 100) < 0.01).sum() == count
    gore = templates.gore(DOME, 0, 20)
    arc_mm = 1e3 * RADIUS_M * np.radians(32)
    assert gore.length_mm == pytest.approx(arc_mm, rel=1e-4)


def inflated(stream: bytes) -> bytes:
    """A stream's content; empty if it is not compressed."""
    try:
        return zlib.decompressobj().decompress(stream)
    except zlib.error:
        return b""


def test_an_unknown_paper_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown paper 'b4'; allowed: a4, a3, roll, gore"):
        write_pdf(tmp_path / "gores.pdf", DOME, "b4")
    assert not list(tmp_path.iterdir())


def test_gores_of_a_sheet_are_no_wider_than_it() -> None:
    for page in pages(DOME, "a4"):
        for shape in page.shapes:
            if isinstance(shape, Polyline) and shape.closed:
                assert np.ptp(shape.xy_mm[:, 0]) <= 210 - 2 * templates.MARGIN_MM
