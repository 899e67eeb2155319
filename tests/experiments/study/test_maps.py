"""Maps over the directions of the attitudes: their cells, projections and contents, and the worst trials."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.dynamics import guidance
from skysim.experiments.study import study_file, worst
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.outcomes import FIELDS
from skysim.experiments.study.plan import Map, Study
from skysim.experiments.study.report import maps
from skysim.experiments.study.table import PointRow, PointTable
from skysim.results.metrics import Columns
from skysim.scene.sections.motion import AttitudeConfig

RNG = np.random.default_rng(12)
STUDY: dict[str, Any] = {
    "schema": 1,
    "title": "Where?",
    "scene": "afit_simsat",
    "seed": 1,
    "trial": {"kind": "centroids"},
    "factors": {"leds": {"key": "light.layout.count", "values": [500, 900]}},
    "responses": ["identified"],
}


def columns(
    count: int, sky: bool = False, low: float = 0.0, high: float = 30.0, **given: Any
) -> Columns:
    """Solved trials in random directions, uniform in solid angle; `given` replaces columns."""
    table: dict[str, Any] = {name: np.full(count, np.nan) for name in FIELDS}
    table |= {
        name: np.zeros(count)
        for name in ("wrong", "ambiguous", "misidentified", "roll_noise", "misled")
    }
    table |= {
        "trial": np.arange(count),
        "point": np.zeros(count, int),
        "seed": np.arange(count),
    }
    table |= {
        "frames": np.ones(count),
        "solved": np.ones(count),
        "stars": np.full(count, 9.0),
    }
    table |= {
        name: np.ones(count) for name in ("x_arcsec", "y_arcsec", "roll_arcsec", "nees")
    }
    table["status"] = np.full(count, "solved", dtype=object)
    around = RNG.uniform(0, 360, count)
    if sky:
        sine = RNG.uniform(math.sin(math.radians(low)), math.sin(math.radians(high)), count)
        table |= {
            "boresight_ra_deg": around,
            "boresight_dec_deg": np.degrees(np.arcsin(sine)),
        }
    else:
        cosine = RNG.uniform(math.cos(math.radians(high)), math.cos(math.radians(low)), count)
        table |= {"body_azimuth_deg": around, "body_tilt_deg": np.degrees(np.arccos(cosine))}
    return table | given


# Cells.


@pytest.mark.parametrize(
    ("sky", "low", "high"),
    [
        (False, 0.0, 30.0),
        (False, 20.0, 21.0),
        (False, 0.0, 90.0),
        (True, -90.0, 90.0),
        (True, 10.0, 60.0),
    ],
)
@pytest.mark.parametrize("count", [60, 1500, 20_000])
def test_cells_cover_the_directions_once_and_are_about_equal(
    sky: bool, low: float, high: float, count: int
) -> None:
    """Solid angles by cos and sin of the edges: their sum is the region's, each is within twice the mean."""
    cells = list(maps.partition(low, high, count, sky))

    def height(deg: float) -> float:
        return math.sin(math.radians(deg)) if sky else 1 - math.cos(math.radians(deg))

    sr = [(height(b) - height(a)) * math.radians(right - left) for a, b, left, right in cells]
    assert sum(sr) == pytest.approx(2 * math.pi * (height(high) - height(low)), rel=1e-9)
    assert max(sr) < 2 * np.mean(sr)
    assert min(sr) > np.mean(sr) / 2
    assert 4 <= len(cells) <= 1.4 * maps.MAX_CELLS
    for ring in {(a, b) for a, b, *_ in cells}:
        sectors = sorted((left, right) for a, b, left, right in cells if (a, b) == ring)
        assert sectors[-1][1] - sectors[0][0] == 360
        assert all(one[1] == other[0] for one, other in itertools.pairwise(sectors))


@pytest.mark.parametrize("sky", [False, True])
def test_each_trial_is_in_one_cell(sky: bool) -> None:
    table = columns(3000, sky, *((-90, 90) if sky else (0, 30)))
    panel = maps.direction_map("", table, "identified")
    assert panel.sky == sky
    assert sum(cell.values for cell in panel.cells) == 3000
    mean = 3000 / len(panel.cells)
    # Counts are binomial: within five sigmas of a mean that is right to a factor of two.
    assert all(
        mean / 2 - 5 * math.sqrt(mean) < cell.values < 2 * mean + 5 * math.sqrt(mean)
        for cell in panel.cells
    )


def test_a_cell_has_the_response_of_its_own_trials() -> None:
    """Lights grow with tilt and the half at azimuths below 180 deg is ambiguous."""
    table = columns(2000)
    ambiguous = (table["body_azimuth_deg"] < 180).astype(float)
    table = {
        **table,
        "stars": np.floor(table["body_tilt_deg"]),
        "ambiguous": ambiguous,
        "solved": 1 - ambiguous,
    }
    shares = maps.direction_map("", table, "ambiguous").cells
    assert {cell.value for cell in shares if cell.right_deg <= 180} == {1.0}
    assert {cell.value for cell in shares if cell.left_deg >= 180} == {0.0}
    for cell in maps.direction_map("", table, "stars_least").cells:
        assert math.floor(cell.low_deg) <= cell.value <= cell.low_deg + 3


def test_a_cell_of_too_few_values_is_hatched() -> None:
    """Only one in twenty is solved, so most cells of 25 trials have fewer than five values."""
    solved = np.arange(1500) % 20 == 0
    table = columns(1500, roll_arcsec=np.where(solved, 5.0, np.nan))
    panel = maps.direction_map("", table, "roll_arcsec_median")
    assert [cell.shown for cell in panel.cells] == [
        cell.values >= maps.MIN_VALUES for cell in panel.cells
    ]
    assert sum(cell.values for cell in panel.cells) == solved.sum()
    assert sum(cell.shown for cell in panel.cells) < len(panel.cells) / 4
    figure = Map(kind="map", value="roll_arcsec_median")
    text = maps.caption(
        [panel], figure, PointTable(study(), [PointRow(0, {"leds": 500}, {})])
    )
    assert f"n = {min(cell.values for cell in panel.cells)} to" in text
    assert "hatched: fewer than 5" in text


# Projections.


def test_the_sky_projection_preserves_areas() -> None:
    """Hammer's projection: the whole sky is an ellipse of area 4 pi; every cell has the area of its solid angle."""
    for low, high, left, right in maps.partition(-90, 90, 2000, True):
        polygon = maps.outline(maps.MapCell(low, high, left, right, 0.0, 9), True)
        x, y = polygon.T
        area = abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2
        solid = (math.sin(math.radians(high)) - math.sin(math.radians(low))) * math.radians(
            right - left
        )
        assert area == pytest.approx(solid, rel=0.01)


def test_directions_have_their_projected_positions() -> None:
    """Hammer: RA 0 in the middle, 90 deg at the left, (90, 0) at x = -2 sqrt 2 sin 45 / sqrt(1 + cos 45); the poles at
    y = +- sqrt 2. Under the dome, tilt 20 at azimuth 90 is (0, 20)."""
    assert maps.place(0.0, 360.0, True) == pytest.approx([0, 0], abs=1e-12)
    half = math.sqrt(0.5)
    assert maps.place(0.0, 450.0, True) == pytest.approx(
        [-2 * math.sqrt(2) * half / math.sqrt(1 + half), 0]
    )
    assert maps.place(90.0, 300.0, True) == pytest.approx([0, math.sqrt(2)], abs=1e-9)
    assert maps.place(0.0, 180.0, True) == pytest.approx([2 * math.sqrt(2), 0])
    assert maps.place(20.0, 90.0, False) == pytest.approx([0, 20], abs=1e-12)
    assert maps.place(20.0, 180.0, False) == pytest.approx([-20, 0], abs=1e-12)


# Figures of a study.


def study(**keys: Any) -> Study:
    return Study.model_validate(STUDY | keys)


def of_points(*tables: Columns) -> Callable[[int], Columns]:
    return lambda point: tables[point]


LINES = PointTable(
    study(), [PointRow(n, {"leds": leds}, {}) for n, leds in enumerate((500, 900))]
)


@pytest.mark.slow
def test_a_map_is_a_picture_with_a_panel_for_each_level() -> None:
    tables = columns(400), columns(400, wrong=np.ones(400))
    for by, labels, wrong in (("leds", ["500", "900"], [0.0, 1.0]), (None, [""], [0.0])):
        figure = Map(kind="map", value="wrong", by=by)
        panels = maps.direction_maps(LINES, figure, of_points(*tables))
        assert [panel.label for panel in panels] == labels
        assert [{cell.value for cell in panel.cells} for panel in panels] == [
            {one} for one in wrong
        ]
        picture = cv2.imdecode(
            np.frombuffer(maps.map_png(panels, figure), np.uint8), cv2.IMREAD_COLOR
        )
        assert picture.shape[1] > picture.shape[0] * len(labels) * 0.9
    assert maps.caption(panels, figure, LINES).startswith(
        "wrong by direction, at leds = 500. Directions of"
    )


def test_the_color_scale_of_a_proportion_is_fixed() -> None:
    """A share of 0.3 everywhere has the color of 0.3 on a scale from 0 to 1, not of the middle of its own range."""
    from matplotlib import colormaps

    table = columns(2000)
    table = {**table, "wrong": (np.arange(2000) % 10 < 3).astype(float)}
    cell = maps.MapCell(0.0, 30.0, 0.0, 360.0, 0.3, 2000)
    panel = maps.DirectionMap("", False, [cell], [])
    image = maps.map_png([panel], Map(kind="map", value="wrong"))
    picture = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    rgb = np.array(colormaps["cividis"](0.3)[:3]) * 255
    near = np.abs(picture[..., ::-1].astype(float) - rgb).max(axis=2) <= 1
    assert near.mean() > 0.2


def test_a_map_without_trials_is_empty() -> None:
    figure = Map(kind="map", value="wrong")
    panels = maps.direction_maps(LINES, figure, lambda point: columns(0))
    assert panels[0].cells == []
    assert maps.caption(panels, figure, LINES).endswith("No trial of it is in yet.")
    assert maps.map_png(panels, figure).startswith(b"\x89PNG")


def test_dome_and_sky_are_not_drawn_in_one_map() -> None:
    dome = columns(50)
    sky = columns(50, True)
    both = {name: np.concatenate([dome[name], sky[name]]) for name in dome}
    with pytest.raises(
        InputError,
        match="map of wrong: trials under a dome and under the stars; allowed: where",
    ):
        maps.direction_map("", both, "wrong")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            {"trial": {"kind": "flight"}},
            r"figures.0.kind: a map of flights, which have no single attitude",
        ),
        (
            {"figures": [{"kind": "map", "value": "wrong", "by": "led"}]},
            "figures.0.by: unknown factor 'led'",
        ),
        (
            {"figures": [{"kind": "map", "value": "wrongs"}]},
            "figures.0: unknown response 'wrongs'",
        ),
        (
            {"figures": [{"kind": "map", "value": "wrong", "where": {"leds": 7}}]},
            "figures.0.where.leds: unknown level 7",
        ),
    ],
)
def test_an_impossible_map_is_refused(
    tmp_path: Any, change: dict[str, Any], complaint: str
) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(
        yaml.safe_dump(STUDY | {"figures": [{"kind": "map", "value": "wrong"}]} | change)
    )
    with pytest.raises(InputError, match=complaint):
        study_file.load(path)


def test_a_cell_of_too_few_values_for_its_quantile_is_hatched() -> None:
    """A 95 % quantile needs 20 values, as it would be the largest of fewer. A median needs 5."""
    few = maps.direction_map("", columns(40), "roll_arcsec_p95")
    assert max(cell.values for cell in few.cells) < 20
    assert not any(cell.shown for cell in few.cells)
    assert any(
        cell.shown for cell in maps.direction_map("", columns(40), "roll_arcsec_median").cells
    )
    many = maps.direction_map("", columns(3000), "roll_arcsec_p95")
    assert np.mean([cell.shown for cell in many.cells]) > 0.9
    assert all(cell.shown == (cell.values >= 20) for cell in many.cells)
    figure = Map(kind="map", value="roll_arcsec_p95")
    assert "hatched: fewer than 20" in maps.caption([few], figure, LINES)


# The worst.


def test_the_worst_trials_are_the_largest_errors_in_different_cells() -> None:
    table = columns(500)
    roll = np.linspace(1, 2, 500)
    roll[[7, 8, 40, 90]] = [90, 80, 70, 60]
    tilt = table["body_tilt_deg"].copy()
    azimuth = table["body_azimuth_deg"].copy()
    tilt[[7, 8, 40, 90]] = [10, 12, 25, 25]
    azimuth[[7, 8, 40, 90]] = [100, 101, 10, 200]
    table = {**table, "roll_arcsec": roll, "body_tilt_deg": tilt, "body_azimuth_deg": azimuth}
    found = worst.worst_trials(table, "roll_arcsec_p95")
    assert [one.trial for one in found] == [7, 40, 90]  # 8 is beside 7
    assert (found[0].direction, found[0].event) == (
        "tilt 10.0°, azimuth 100°",
        "cross 1.41″, roll 90″",
    )


def test_the_worst_trials_of_a_proportion_are_its_failures() -> None:
    """Ambiguous ones first by being unsolved, then by the fewest lights; `identified` names those that are not."""
    table = columns(300, low=0, high=90)
    apart = np.linspace(0, 300, 300) % 360
    ambiguous = np.zeros(300)
    stars = np.full(300, 9.0)
    ambiguous[[3, 60, 150]] = 1
    stars[[3, 60, 150]] = [5, 3, 4]
    status = np.where(ambiguous > 0, "ambiguous: so", "solved").astype(object)
    error = np.where(ambiguous > 0, np.nan, 1.0)
    table = {
        **table,
        "ambiguous": ambiguous,
        "solved": 1 - ambiguous,
        "stars": stars,
        "status": status,
        "x_arcsec": error,
        "roll_arcsec": error,
        "body_azimuth_deg": apart,
        "body_tilt_deg": np.full(300, 60.0),
    }
    for response in ("ambiguous", "identified", "refused"):
        assert [one.trial for one in worst.worst_trials(table, response)] == [60, 150, 3]
    assert worst.worst_trials(table, "ambiguous")[0].event == "ambiguous: so"
    assert worst.worst_trials(table, "misidentified") == []
    assert [one.trial for one in worst.worst_trials(table, "stars_least", count=2)] == [
        60,
        150,
    ]
    assert [one.trial for one in worst.worst_trials(table, "coverage_4", count=1)] == [60]


def test_a_plain_quantity_ranks_single_trials() -> None:
    """Of a study in which every trial is identified the worst are those of the greatest error."""
    table = columns(60, roll_arcsec=np.arange(60.0))
    assert worst.worst_trials(table, "identified") == []
    assert worst.worst_trials(table, "roll_arcsec")[0].trial == 59
    by_quantity, by_response = (
        worst.worst_trials(table, name) for name in ("roll_arcsec", "roll_arcsec_p95")
    )
    assert [one.trial for one in by_quantity] == [one.trial for one in by_response]
    fewest = columns(60, stars=np.arange(60.0) + 4)
    assert worst.worst_trials(fewest, "stars")[0].trial == 0


def test_the_worst_trials_are_printed_as_a_start_section() -> None:
    """`motion.start` turns the body by the stored attitude, to the digits printed."""
    lab_from_body = Rotation.random(60, rng=np.random.default_rng(4))
    quaternion = dict(zip("wxyz", lab_from_body.as_quat(scalar_first=True).T, strict=True))
    table = columns(
        60, **{f"lab_from_body_{part}": column for part, column in quaternion.items()}
    )
    first = worst.worst_trials(table, "roll_arcsec")[0]
    start = yaml.safe_load(first.start)["motion.start"]
    back = guidance.attitude(AttitudeConfig.model_validate(start))
    assert (back.inv() * lab_from_body[first.trial]).magnitude() < np.radians(2e-3)
    assert worst.worst_trials(columns(60, sky=True), "roll_arcsec")[0].start == ""


@pytest.mark.slow
def test_the_worst_trials_are_replayed_by_their_number() -> None:
    """A trial is replayed from the number in the list, with the same attitude and error."""
    plan = study_file.load("led_count", {"replicates": "40"})
    point = next(
        n
        for n, one in enumerate(plan.points)
        if one.levels == {"leds": 1000, "placement": "poisson"}
    )
    segment = trials.Segment(point, plan.points[point].settings, 40 * point, range(40))
    rows = trials.TrialJob(plan.spec).run((segment,))
    table: dict[str, Any] = {
        name: np.array([getattr(row.outcome, name) for row in rows]) for name in FIELDS
    }
    table |= {
        name: np.array([getattr(row, name) for row in rows])
        for name in ("trial", "point", "seed")
    }
    first = worst.worst_trials(table, "roll_arcsec_p95")[0]
    (again,) = trials.TrialJob(plan.spec).run(
        (
            segment._replace(
                first=first.trial, replicates=range(first.trial % 40, first.trial % 40 + 1)
            ),
        ),
    )
    assert abs(again.outcome.roll_arcsec) == pytest.approx(first.roll_arcsec, rel=1e-12)
    assert again.outcome.body_tilt_deg == first.tilt_deg
    assert first.roll_arcsec == np.nanmax(np.abs(table["roll_arcsec"]))
