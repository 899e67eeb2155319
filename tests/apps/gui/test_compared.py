"""Two flights side by side: strips, differences, medians, files and frames are those of each flight's one record."""

from __future__ import annotations

import csv
import io
import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.messages import FlightRow
from skysim.apps.gui.page.run_panel import KeptRun, description, flight_table, with_kept
from skysim.apps.gui.page.strips import Strip, same_times, strips
from skysim.apps.gui.views.context import PageView
from skysim.apps.gui.worker.tasks import Worker
from skysim.core.errors import InputError
from skysim.scene import loader
from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    choose_stage,
    come,
    onto_the_page,
    open_scene,
    opened,
    panel,
    pictured,
    simulate,
)
from tests.helpers.solutions import flown, numbers, solution

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


def rows(
    times_s: Sequence[float], cross_arcsec: Sequence[float], roll_arcsec: Sequence[float]
) -> list[FlightRow]:
    """Rows of a flight; a frame whose error is NaN is refused."""
    found = []
    for t_s, cross, roll in zip(times_s, cross_arcsec, roll_arcsec, strict=True):
        status = "too few" if math.isnan(cross) else "solved"
        row = solution((), status, t_s=t_s, cross_arcsec=cross, roll_arcsec=roll).row
        found.append(FlightRow(row, 5, 0, math.nan, math.nan))
    return found


def strip(found: list[Strip], title: str) -> Strip:
    return next(one for one in found if one.title.startswith(title))


def test_differences_are_of_frames_at_the_same_time_that_both_have_solved() -> None:
    nan = math.nan
    own = rows([0.1, 0.2, 0.3, 0.4], [3.0, 5.0, 2.0, 1.0], [-4.0, 1.0, 2.0, 9.0])
    # The second frame is refused, the third one is 0.1 ms later, and the first differs by a rounding of its time.
    kept = rows([0.1 + 1e-12, 0.2, 0.3001, 0.4], [1.0, nan, 7.0, 1.5], [2.0, nan, 7.0, 8.0])
    change = strip(strips(own, {}, (), kept), "error minus")
    points = {curve.name: curve.points for curve in change.curves}
    assert points == {"cross": [[0.1, 2.0], [0.4, -0.5]], "roll": [[0.1, -6.0], [0.4, 1.0]]}
    assert [(one.t_s, other.cross_arcsec) for one, other in same_times(own, kept)][2:] == [
        (0.4, 1.5)
    ]


def test_no_difference_is_drawn_without_common_frames_or_reference() -> None:
    own = rows([0.1], [3.0], [1.0])
    for kept in ([], rows([0.2], [3.0], [1.0])):
        assert not any(
            one.title.startswith("error minus") for one in strips(own, {}, (), kept)
        )


def test_both_flights_are_in_one_file_with_their_names() -> None:
    dome = loader.load("afit_simsat", {})
    sky = loader.load("shefex2", {})
    shown = description(PageView("shefex2", {"seed": "2"}), rows([0.5], [4.0], [1.0]))
    kept = KeptRun(shown, sky, rows([0.5], [4.0], [1.0]), [], 1.0)
    own = flight_table(rows([0.1, 0.2], [3.0, math.nan], [1.0, math.nan]), dome)
    table = with_kept(own, "afit_simsat", kept)
    assert list(table["run"]) == ["afit_simsat"] * 2 + ["shefex2, seed=2"]
    np.testing.assert_array_equal(table["cross_arcsec"], [3.0, math.nan, 4.0])
    # A flight under the dome has no right ascension, one under the sky no pitch.
    assert np.isnan(table["true_ra_deg"]).tolist() == [True, True, False]
    assert np.isnan(table["true_pitch_deg"]).tolist() == [False, False, True]


def test_a_flight_s_description_has_its_command_and_its_record_s_numbers() -> None:
    view = PageView("two_heads", {"exposure.time": "2 ms"}, head="side")
    found = description(
        view, rows([0.1, 0.2, 0.3], [3.0, math.nan, 5.0], [-1.0, math.nan, 2.0])
    )
    assert found["name"] == "two_heads, exposure.time=2 ms, camera side"
    assert shlex.split(found["command"]) == [
        *("skysim", "run", "two_heads"),
        *("--set", "exposure.time=2 ms"),
    ]
    run = found["run"]
    assert [run[key] for key in ("frames", "solved", "wrong")] == [3, 2, 0]
    assert run["cross_arcsec_median"] == np.median([3.0, 5.0])
    assert run["roll_arcsec_median"] == np.median([1.0, 2.0])
    assert description(view, ())["run"] is None


@pytest.mark.slow
def test_the_reference_s_frames_survive_another_scene_and_another_flight() -> None:
    worker = Worker()
    few = {"exposure.frames": "2"}
    worker.open("afit_simsat_ideal", few, False)
    with pytest.raises(InputError, match="lost with their worker"):
        worker.kept_frame(0)
    kept = flown(worker)
    worker.flight_frame(1)
    frame = worker.export()["frame.png"]
    worker.keep_flight(True)
    # Another tracker on the same laboratory, then another scene.
    for scene, overrides in (
        ("afit_simsat_ideal", few | {"tracker.solver": "pnp"}),
        ("shefex2", few),
    ):
        worker.open(scene, overrides, False)
        own = flown(worker)
        before = worker.workbench.lab_from_body
        photo = worker.kept_frame(1)
        assert numbers(photo.result.row) == numbers(kept[1].row)
        assert numbers(own[1].row) != numbers(kept[1].row)
        assert worker.export()["frame.png"] == frame
        assert worker.workbench.lab_from_body is before
    worker.keep_flight(False)
    with pytest.raises(InputError, match="lost with their worker"):
        worker.kept_frame(1)


# In the browser.


SHOWN = """() => { const strips = getElement(+document.querySelector(".lab-strips").id.slice(1));
  return strips.chart.getOption().series.map(({ name, data, xAxisIndex }) => [name, xAxisIndex, data]); }"""


def columns(path: Path) -> dict[str, list[str]]:
    table = list(csv.DictReader(io.StringIO(path.read_text())))
    return {name: [row[name] for row in table] for name in table[0]}


def median(path: Path, run: str) -> float:
    """Median cross error of the solved frames of a run in a file of both."""
    found = columns(path)
    lines = zip(found["run"], found["status"], found["cross_arcsec"], strict=True)
    return float(
        np.median(
            [
                float(error)
                for name, status, error in lines
                if (name, status) == (run, "solved")
            ]
        )
    )


@pytest.mark.browser
@in_browser
def test_two_flights_are_shown_over_each_other(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    with opened(browser, server.login, NARROW) as page:
        page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        open_scene(page, "afit_simsat_ideal")
        simulate(page, 6)
        page.get_by_text(re.compile(r"6/6$")).wait_for()
        page.get_by_role("button", name="Keep as reference").click()
        compared = page.locator(".lab-compared")
        compared.get_by_text("is kept as the reference. Simulate another flight.").wait_for()
        choose_stage(page, "solver", "pnp")
        # Another scene or key leaves the reference, with its name.
        panel(page, "Run")
        own = "afit_simsat_ideal, exposure.frames=6, tracker.solver=pnp"
        kept = "afit_simsat_ideal, exposure.frames=6"
        compared.get_by_text(f"{kept} is kept as the reference").wait_for()
        onto_the_page(page)
        page.get_by_role("button", name="Simulate").click()
        page.get_by_text(re.compile(r"6/6$")).wait_for()
        sentence = compared.get_by_text(re.compile("Median cross error"))
        sentence.wait_for()
        with page.expect_download() as comes:
            page.get_by_role("button", name="CSV").click()
        path = tmp_path / "both.csv"
        comes.value.save_as(path)
        text = sentence.inner_text()
        assert f"(reference: {kept})" in text
        assert "Frames solved 6 against 6, wrong 0 against 0, refused 0 against 0." in text
        shown = re.search(r"error ([\d.e-]+)″ against ([\d.e-]+)″", text)
        assert shown
        expected = [median(path, own), median(path, kept)]
        np.testing.assert_allclose(np.array(shown.groups(), float), expected, rtol=1e-3)
        # The strips have both flights' points, and the difference is that of the file's columns.
        curves = page.evaluate(SHOWN)
        table = columns(path)
        errors = np.array(table["cross_arcsec"], float).reshape(2, 6)
        times_s = np.array(table["t_s"], float).reshape(2, 6)
        for name, strip_n, values in (
            ("tracker", 0, errors[0]),
            ("reference", 0, errors[1]),
            ("cross", 2, errors[0] - errors[1]),
        ):
            (points,) = (data for curve, at, data in curves if (curve, at) == (name, strip_n))
            np.testing.assert_allclose([x for x, _ in points], times_s[0], rtol=0, atol=1e-4)
            np.testing.assert_allclose([y for _, y in points], values, rtol=1e-4, atol=1e-3)
        page.get_by_role("button", name="Copy both commands").click()
        page.get_by_role("button", name="Copied").wait_for()
        commands = page.evaluate("navigator.clipboard.readText()").strip().split("\n")
        assert commands == [
            "skysim run afit_simsat_ideal --set exposure.frames=6 --set tracker.solver=pnp",
            "skysim run afit_simsat_ideal --set exposure.frames=6",
        ]
        pictured(page, "two_flights")
        page.get_by_role("button", name="Other flight's frame").click()
        page.get_by_text(re.compile(r"^image reference at ")).wait_for()
        page.get_by_role("button", name="Other flight's frame").click()
        page.get_by_text(re.compile(r"^flight at ")).wait_for()
        page.get_by_role("button", name="Forget the reference").click()
        compared.wait_for(state="detached")
        assert come(lambda: not any(name == "reference" for name, *_ in page.evaluate(SHOWN)))
