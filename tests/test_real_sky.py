"""Real photographs of the night sky with attitudes from two agreeing independent solvers.

The folder is beside the checkout or at SKYSIM_REAL_SKY; its README describes how the truth was made.
"""

import csv
import os
from pathlib import Path

import numpy as np
import pytest

from skysim.apps import plate_solver
from skysim.core import images
from skysim.core.paths import ROOT
from skysim.sources.stars import cam_from_icrs

FOLDER = Path(os.environ.get("SKYSIM_REAL_SKY", ROOT.parent / "shared" / "real_sky"))
MANIFEST = FOLDER / "manifest.csv"
ROWS = list(csv.DictReader(MANIFEST.open())) if MANIFEST.is_file() else []
TO_SOLVE = [row for row in ROWS if row["expect"] == "solve"]
NOT_TO_SOLVE = [row for row in ROWS if row["expect"] == "refuse"]
ANY = [row for row in ROWS if row["expect"] == "any"]

needs_photographs = pytest.mark.skipif(
    not ROWS, reason=f"no photographs of the real sky in {FOLDER}"
)


def by_file(rows, quick: int = 1):
    """One test per photograph; every `quick`-th is not marked slow."""
    marks = [() if k % quick == 0 else pytest.mark.slow for k in range(len(rows))]
    params = [
        pytest.param(row, marks=mark, id=row["file"])
        for row, mark in zip(rows, marks, strict=True)
    ]
    return pytest.mark.parametrize("row", params)


def answer(row, fov_error: float) -> dict:
    """Result of `skysim solve` for a photograph if the given field of view has this relative error."""
    fov_deg = float(row["fov_deg_horizontal"] or 10.0) * (1 + fov_error)
    return plate_solver.solve_file(
        FOLDER / row["file"], plate_solver.make_solver(fov_deg, None)
    )


@pytest.fixture(scope="module")
def blind() -> plate_solver.Solver:
    """Solver without a field of view; it keeps its trackers for photographs of one size."""
    return plate_solver.make_solver(None, None)


def errors_deg(found: dict, row) -> tuple[float, float]:
    """Cross-boresight and roll error at the image's middle."""
    true = cam_from_icrs(*(float(row[key]) for key in ("ra_deg", "dec_deg", "roll_deg")))
    ours = cam_from_icrs(found["ra_deg"], found["dec_deg"], found["roll_deg"])
    x, y, z = np.degrees((ours * true.inv()).as_rotvec())
    return float(np.hypot(x, y)), abs(float(z))


def check_right(found: dict, row) -> None:
    assert found["status"] == "solved"
    cross, roll = errors_deg(found, row)
    assert cross < 0.05
    assert roll < 0.2
    # The manifest's field of view is another's fit of another lens model: half a per cent is agreement.
    assert found["fov_deg"] == pytest.approx(float(row["fov_deg_horizontal"]), rel=5e-3)


@needs_photographs
@by_file(TO_SOLVE, quick=4)
def test_a_photograph_is_solved_with_its_field_known_to_five_per_cent(row):
    worst = 0.05 if TO_SOLVE.index(row) % 2 else -0.05
    check_right(answer(row, worst), row)


@pytest.mark.slow
@needs_photographs
@by_file(NOT_TO_SOLVE)
def test_a_picture_without_stars_is_refused(row):
    found = answer(row, 0.0)
    assert found["status"] != "solved"
    assert found["ra_deg"] is None
    assert not found["bad_input"]


@needs_photographs
@by_file(TO_SOLVE[4:5])
def test_a_photograph_is_solved_with_its_field_unknown(row, blind):
    check_right(plate_solver.solve_file(FOLDER / row["file"], blind), row)


@pytest.mark.long
@needs_photographs
@by_file(TO_SOLVE)
def test_every_photograph_is_solved_with_its_field_unknown(row, blind):
    check_right(plate_solver.solve_file(FOLDER / row["file"], blind), row)


@pytest.mark.long
@needs_photographs
@by_file(NOT_TO_SOLVE + ANY)
def test_no_photograph_is_answered_wrongly_with_its_field_unknown(row, blind):
    found = plate_solver.solve_file(FOLDER / row["file"], blind)
    right = (
        bool(row["ra_deg"])
        and found["status"] == "solved"
        and errors_deg(found, row)[0] < 0.05
    )
    assert right or found["status"] != "solved"
    assert not found["bad_input"]


@pytest.mark.long
@needs_photographs
@by_file(TO_SOLVE)
def test_a_mirrored_photograph_is_refused(row, blind):
    """No rotation maps the sky to its mirror image, so every answer would be wrong; the hint names the mirror."""
    image = images.monochrome(images.read_image(FOLDER / row["file"]))
    outcome = plate_solver.solve_picture(
        images.ViewedImage(np.ascontiguousarray(image[:, ::-1])), blind
    )
    assert not outcome.report.attitude.solved
    assert len(outcome.report.centroids) >= 10
    assert plate_solver.outcome_fields(outcome)["hint"].startswith("perhaps mirrored: ")


@pytest.mark.long
@needs_photographs
@pytest.mark.parametrize("fov_error", [-0.05, -0.025, 0.0, 0.025, 0.05])
@by_file(TO_SOLVE)
def test_a_photograph_is_solved_with_any_field_error_below_five_per_cent(row, fov_error):
    check_right(answer(row, fov_error), row)


@pytest.mark.long
@needs_photographs
@pytest.mark.parametrize("fov_error", [-0.05, 0.0, 0.05])
@by_file(ANY)
def test_a_hopeless_photograph_is_refused_or_answered_correctly(row, fov_error):
    found = answer(row, fov_error)
    right = (
        bool(row["ra_deg"])
        and found["status"] == "solved"
        and errors_deg(found, row)[0] < 0.05
    )
    assert right or found["status"] != "solved"
