"""Messages that a wrong file of any kind gives: one short line in plain words, with the line at fault."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from estimator.catalog import cat_file, catalog
from estimator.core.errors import ImageError
from skysim.apps.plate_solver import picture
from skysim.camera.psf.otf import read_cells
from skysim.core import files, images
from skysim.core.errors import InputError, Where, reason
from skysim.scene import opencv_calibration
from skysim.sources import catalog as star_catalog
from skysim.sources import photometry
from skysim.sources.dome import point_cloud
from skysim.sources.dome.layouts import listed
from tests.fuzz import campaign

TEXTS = ("", "a.b", "☃" * 190, "x" * 399, "a, " * 3000, "y" * 10_000)
# The lists that users write, with a good row, and their readers.
LISTS: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "LEDs": ("azimuth_deg,tilt_deg", "{0},{0}", listed.read_csv),
    "lights": ("x_px,y_px,flux", "{0},{0},1", picture.read_lights),
    "points": ("x,y,z", "{0},0,1", lambda path: point_cloud.read(str(path), "m")),
    "curve": ("wavelength_nm,response", "{0},1", photometry._read_curve.__wrapped__),
}
READERS: tuple[Callable[[Path], object], ...] = (
    *(read for *_, read in LISTS.values()),
    files.read_table,
    star_catalog.read,
    catalog.read,
    cat_file.read,
    opencv_calibration.read,
    images.read_pictures,
)


@pytest.mark.parametrize("key", TEXTS)
@pytest.mark.parametrize("problem", TEXTS)
def test_no_message_is_longer_than_a_thousand_characters(key: str, problem: str) -> None:
    for allowed, file in itertools.product(TEXTS, (TEXTS[2], TEXTS[-1])):
        error = InputError(key, problem, allowed, Where(file, 7))
        for one in (
            error,
            error.under("scene"),
            error.within("camera.preset"),
            error.at(None),
        ):
            assert len(str(one)) <= campaign.MESSAGE_CHARACTERS
        # The place is kept.
        assert "line 7" in str(error)


def test_reasons_are_in_plain_words() -> None:
    errors: list[Exception] = [
        OSError(28, "No space left on device"),
        OverflowError(34, "Numerical result out of range"),
    ]
    with pytest.raises(UnicodeDecodeError) as undecoded:
        b"ab\xff".decode()
    assert [reason(error) for error in (*errors, undecoded.value)] == [
        "No space left on device",
        "Numerical result out of range",
        "not text in UTF-8, by byte 3",
    ]


@pytest.mark.parametrize("kind", LISTS)
@pytest.mark.parametrize("wrong", ["1,x,1", "1", "nan,nan,nan", "1e300,1e300,1e300", "☃,2"])
@pytest.mark.parametrize("place", [3, 5, 7])
def test_a_list_names_the_line_at_fault(
    tmp_path: Path, kind: str, wrong: str, place: int
) -> None:
    head, row, read = LISTS[kind]
    columns = head.count(",") + 1
    lines = ["# a comment", head, *(row.format(n) for n in range(300, 306))]
    lines[place - 1] = ",".join(wrong.split(",")[:columns])
    path = tmp_path / "list.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError, match=f"list.csv, line {place}: ") as refusal:
        read(path)
    assert not campaign.RAW.search(str(refusal.value))


@pytest.mark.parametrize("place", [6, 7, 9])
@pytest.mark.parametrize("wrong", ["1 x", "1", "1 2 3", '"'])
def test_an_ecsv_table_names_the_first_line_that_is_no_row(
    tmp_path: Path, place: int, wrong: str
) -> None:
    head = "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\n# - {name: b, datatype: float64}\na b"
    lines = [*head.split("\n"), *(f"{n} {n}.5" for n in range(4))]
    path = tmp_path / "x.ecsv"
    path.write_text("\n".join(lines))
    assert len(files.read_table(path)) == 4
    lines[place] = wrong
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=rf"x\.ecsv, line {place + 1}: no row of the table"):
        files.read_table(path)


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("suffix", [".csv", ".ecsv", ".png"])
def test_a_pipe_is_refused_and_not_waited_for(
    tmp_path: Path, read: Callable[[Path], Any], suffix: str
) -> None:
    path = tmp_path / f"x{suffix}"
    os.mkfifo(path)
    with pytest.raises((InputError, ImageError)):
        read(path)


def test_half_precision_is_read_as_numbers_that_can_be_scaled(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    np.save(path, np.full((20, 20), 0.5, np.float16))
    (page,) = images.read_pictures(path)
    light = images.as_light(page)
    assert np.all(np.isfinite(light.pixels))


def test_a_damaged_film_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """FFmpeg and OpenCV's own reader of AVI write to the file descriptor."""
    path = tmp_path / "x.avi"
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (64, 48), False)
    for _ in range(3):
        film.write(np.zeros((48, 64), np.uint8))
    film.release()
    whole = path.read_bytes()
    capfd.readouterr()
    for at in range(8, 400, 4):
        path.write_bytes(whole[:at] + b"zzzz" + whole[at + 4 :])
        with (
            contextlib.suppress(InputError),
            contextlib.closing(images.LiveCamera(str(path))) as film_camera,
        ):
            film_camera.frame()
    assert capfd.readouterr().err == ""


def test_a_psf_of_text_names_its_line(tmp_path: Path) -> None:
    path = tmp_path / "psf.csv"
    path.write_text("0,1,0\n1,x,1\n0,1,0\n")
    with pytest.raises(InputError, match=r"camera\.psf\.file: .*psf\.csv, line 2: 'x'"):
        read_cells.__wrapped__(str(path))


def test_cases_depend_on_the_seed_and_their_number_alone() -> None:
    first = campaign.make_case("wire", 3, 1)
    assert first == campaign.make_case("wire", 3, 1)
    assert first != campaign.make_case("wire", 4, 1)


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        (
            (70, "", "Traceback (most recent call last):\nKeyError: 1", 1, 1, False),
            "traceback",
        ),
        ((-11, "", "", 1, 1, False), "crash"),
        ((0, "", "", 30, 1, True), "time-out"),
        ((0, "", "", 1, 3 << 30, False), "memory"),
        ((0, "", "x.py:3: RuntimeWarning: overflow", 1, 1, False), "library"),
        ((2, "", "skysim: " + "x" * 1001, 1, 1, False), "long"),
        ((2, "", "skysim: a: (34, 'Numerical result out of range')", 1, 1, False), "words"),
        ((2, "", "", 1, 1, False), "silent refusal"),
        ((2, "", "skysim: a\nskysim: b", 1, 1, False), "lines"),
        ((0, "error nan", "", 1, 1, False), "no number"),
    ],
)
def test_every_kind_of_finding_is_found(answer: tuple[Any, ...], kind: str) -> None:
    case = campaign.Case(("check", "x.yaml"), campaign.Mutant(b"", "nothing"))
    found = list(campaign.findings("wire", case, campaign.Answer(*answer)))
    assert [one.partition(":")[0] for one in found] == [kind]


@pytest.mark.long
def test_no_wrong_input_gives_anything_but_one_line() -> None:
    """`python -m tests.fuzz.campaign 3000` is the whole campaign."""
    records = campaign.run(100, 2026, 1, list(campaign.READERS))
    assert [one for one in records if one["findings"]] == []
