"""The experiments of a datasheet as one study: each cell sets keys of the scene and of the trial, in the same fields.

A field is a replicate: a random attitude, the same in all cells with the same `attitude_seed`. A cell chooses unit,
thermal state, attitude and noise by number, so that terms can be separated and causes compared on the same frames.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from skysim.camera import as_built
from skysim.core.constants import DAY_S, HOUR_S
from skysim.core.errors import InputError, errors_within
from skysim.core.files import make_folder, write_text
from skysim.core.types import Array, Bools, Floats, Record
from skysim.core.yaml_reader import OverrideTexts, parse_yaml
from skysim.experiments.datasheet import scene_changes
from skysim.experiments.study.execution import runner, store
from skysim.experiments.study.factors import Point, Settings
from skysim.experiments.study.plan import Plan, Study, TrialSpec, resolve_point
from skysim.experiments.study.study_file import dome_seeds, make_plan
from skysim.experiments.study.unused_options import tracks
from skysim.scene.scene import Scene

MIN_FIELDS = 10  # minimum number of fields in which all frames of the terms are solved
MODEL_FIELDS = 2 * MIN_FIELDS  # for an error model: each half of them tests that of the other

# Step from one attitude of a field to the next: the same stars at other phases in the pixels.
SCAN_PX = 3.37
STREAKS_PX = (
    0.5,
    1.0,
    2.0,
    4.0,
    8.0,
    16.0,
    32.0,
)  # lengths of the streaks, which give the rates
BORESIGHT_PX = (
    2.0,
    8.0,
    32.0,
)  # lengths of the streaks at the edge, in turns about the boresight
# Experiments at a rate, with their further settings. They go on at twice the rate until most fields fail.
RATES: dict[str, Settings] = {"rate": {}, "boresight": {"trial.rate_axis": "boresight"}}
MOST_FAIL = 0.5  # share of the fields that must be right in both frames for a faster rate
SEQUENCE = (0, 1, 2, 4, 8, 16)  # frames of a sequence at a constant rate
SEQUENCE_RATES = 4  # number of the slowest rates that have sequences, as rest has
FAINTER = (
    -1.0,
    -0.5,
    0.5,
)  # magnitudes by which the limit of the tracker's catalog is varied
BENDS_PX = (1.0, 4.0, 16.0, 64.0)  # acceleration times the square of the exposure time
TRACKED = 2  # frames before one in tracking mode: the second one gives a rate
TRACKED_STREAKS_PX = (2.0, 8.0, 16.0, 32.0)  # lengths of the streaks in tracking mode
# Acceleration times the square of the time between frames, in tracking mode.
MISSED_PX = (8.0, 30.0, 60.0, 120.0)


class Size(NamedTuple):
    """Numbers of fields, units, thermal states, attitudes in a field, frames at an attitude, and other cells.

    Attributes
    ----------
    draws
        Independent frames in each field: each with another attitude and noise, and with the next
        unit and thermal state
    sky
        Frames in new fields, of other units
    pairs
        Pairs of frames with and without a cause
    """

    fields: int
    units: int
    states: int
    attitudes: int
    frames: int
    draws: int
    sky: int
    pairs: int


QUICK = Size(fields=40, units=4, states=3, attitudes=2, frames=2, draws=8, sky=12, pairs=2)
FULL = Size(fields=300, units=8, states=4, attitudes=2, frames=2, draws=32, sky=4, pairs=2)


class DatasheetCell(NamedTuple):
    """One cell: its experiment, its levels there, and its settings."""

    experiment: str
    levels: Record
    settings: Settings

    @property
    def name(self) -> str:
        """The name of its level in the study."""
        return " ".join(
            [self.experiment, *(f"{key} {value}" for key, value in self.levels.items())]
        )


Cells = Iterator[DatasheetCell]
CellRows = list[int]  # numbers of cells


def check_scene(scene: Scene) -> None:
    """Raise InputError for a scene whose tracker gives no attitude for a single frame."""
    if scene.light.kind == "collimated_display":
        raise InputError("light.kind", "collimated_display has one field only", "stars, dome")
    if scene.tracker.decoder:
        raise InputError(
            "tracker.decoder",
            "gives no attitude for one frame",
            "none (tracker.decoder=null and light.led.code=null)",
        )
    if scene.tracker.exposure_control:
        raise InputError(
            "tracker.exposure_control",
            "the frames of a datasheet have one exposure time",
            "none (tracker.exposure_control=null)",
        )


def require_fields(fields: int, solved: int, least: int, problem: str) -> None:
    """Raise InputError if fewer than `least` of the fields are solved, with a number of fields that is enough."""
    if solved < least:
        enough = (
            least if solved == fields else math.ceil(1.5 * least * fields / max(solved, 1))
        )
        raise InputError(
            "datasheet.fields", f"{fields}: {problem}, {least} needed", f"{enough} or more"
        )


def unit_seeds(scene: Scene) -> list[str]:
    """Keys of the seeds that differ from unit to unit: chip, survey, LEDs."""
    has_pattern = any(
        getattr(scene.camera.detector, key) for key in scene_changes.FIXED_PATTERN
    )
    seeds = ["camera.detector.hardware_seed"] if has_pattern else []
    return seeds + dome_seeds(scene)


def states_c(scene: Scene, count: int) -> list[float]:
    """Temperatures of `count` thermal states, at equal steps of the scene's history; none without the section.

    The history is one period of a sine, a table from its first to its last time, or a day.
    """
    config = scene.thermal
    if config is None:
        return []
    history = config.temperature
    hours = np.linspace(
        0, getattr(history, "period_s", DAY_S) / HOUR_S, count, endpoint=False
    )
    if history.kind == "table":
        hours = np.linspace(history.hours[0], history.hours[-1], count)
    if history.kind == "steady":
        hours = hours[:1]
    return [float(as_built.TEMPERATURES[history.kind](history, hour)) for hour in hours]


class Designer:
    """Makes the cells of a scene.

    Parameters
    ----------
    rates_deg_s
        Rates in place of those that follow from the camera
    """

    def __init__(
        self,
        scene: Scene,
        size: Size,
        rates_deg_s: Sequence[float] = (),
    ) -> None:
        self.scene = scene
        self.size = size
        self.chosen_rates_deg_s = sorted({rate for rate in rates_deg_s if rate})
        self.seeds = unit_seeds(scene)
        self.temperatures_c = states_c(scene, size.states)
        self.pixel_deg = math.degrees(1 / scene.camera.focal_px)
        self.under_stars = scene.stars is not None
        self.noise = 0
        # Equal units are one, as is a scene without thermal states.
        self.units = size.units if self.seeds else 1
        self.states = max(len(self.temperatures_c), 1)

    def settings(
        self, unit: int = 0, state: int = 0, attitude: int = 0, turn_deg: float = 0.0
    ) -> Settings:
        """Settings of a unit, a thermal state and an attitude in the field by their numbers, with new noise.

        `turn_deg` is added to the rotation of the attitude.
        """
        self.noise += 1
        chosen: Settings = {key: 1000 + unit for key in self.seeds}
        if self.temperatures_c:
            temperature_c = self.temperatures_c[state % self.states]
            chosen["thermal.temperature"] = {"kind": "steady", "temperature_c": temperature_c}
        turn_deg += attitude * SCAN_PX * self.pixel_deg
        return chosen | {"trial.noise_seed": self.noise, "trial.turn_deg": turn_deg}

    def cells(self) -> Cells:
        """All cells, in the order in which they are run."""
        yield from self.terms()
        combinations = self.units * self.states
        yield from self.draws(
            "total", math.ceil(self.size.draws / combinations) * combinations
        )
        for number in range(self.size.sky):
            settings = self.settings(100 + number, number)
            settings["trial.attitude_seed"] = 1 + number
            yield DatasheetCell("sky", {"draw": number}, settings)
        yield from self.rates()
        yield from self.sequences()
        # Pairs at accelerations, with a rate of zero at mid-exposure.
        for bend in self.accelerations_deg_s2(BENDS_PX, self.scene.exposure.time_s):
            yield from self.pair("acceleration", "trial.acceleration_deg_s2", bend)
        yield from self.tracked()
        yield from self.magnitudes()
        pairs = max(self.size.pairs, self.states)
        for name, change in scene_changes.causes(self.scene).items():
            yield from self.draws("cause", pairs, change, cause=name)
        for name, change in scene_changes.disturbances(self.scene).items():
            yield from self.draws("disturbance", 1, change, disturbance=name)
        for body, off_deg in itertools.product(
            scene_changes.excluding_bodies(self.scene), scene_changes.OFF_DEG
        ):
            change = scene_changes.beside(body, off_deg, off_deg)
            yield from self.draws("exclusion", 1, change, body=body, off_deg=off_deg)

    def terms(self) -> Cells:
        """The crossed and nested design of `components`."""
        counts = (self.units, self.states, self.size.attitudes, self.size.frames)
        for numbers in itertools.product(*map(range, counts)):
            levels = dict(zip(("unit", "state", "attitude", "frame"), numbers, strict=True))
            yield DatasheetCell("terms", levels, self.settings(*numbers[:3]))

    def draws(
        self, experiment: str, count: int, change: Settings | None = None, **levels: Any
    ) -> Cells:
        """Frames of other attitudes. With a change they are otherwise equal to those without it, noise included.

        They have the units and thermal states of the terms in turn: the mean bias of a few other units would be
        another. The first `states` draws have all thermal states, and the first `states` times `units` all
        combinations.
        """
        for number in range(count):
            turns, state = divmod(number, self.states)
            settings = self.settings((turns + state) % self.units, state, 10 + number)
            settings |= {"trial.noise_seed": 10_000 + number} | (change or {})
            if settings.get("trial.kind") == "centroids":
                del settings["trial.turn_deg"]
            yield DatasheetCell(experiment, {**levels, "draw": number}, settings)

    def rates_deg_s(
        self, streaks_px: Sequence[float], experiment: str = "rate"
    ) -> list[float]:
        """Rates with streaks of these lengths, to two digits; about the boresight those at the edge of the field."""
        pixel_deg = self.pixel_deg
        if experiment == "boresight":
            pixel_deg = math.degrees(2 / scene_changes.side_px(self.scene))
        per_px = pixel_deg / self.scene.exposure.time_s
        return [float(f"{streak * per_px:.2g}") for streak in streaks_px]

    def accelerations_deg_s2(self, bends_px: Sequence[float], time_s: float) -> list[float]:
        """Accelerations that bend a path by these lengths in a time, to two digits."""
        return [float(f"{bend * self.pixel_deg / time_s**2:.2g}") for bend in bends_px]

    def pair(
        self, experiment: str, key: str, level: float, change: Settings | None = None
    ) -> Cells:
        """Two frames of each attitude at a level of a key, which differ only in their noise.

        Parameters
        ----------
        change
            Further settings
        """
        name = key.rpartition(".")[2]
        for frame in range(2):
            settings = self.settings() | {key: level} | (change or {})
            yield DatasheetCell(experiment, {name: level, "frame": frame}, settings)

    def rates(self) -> Cells:
        """Pairs of frames at each rate, across the boresight and about it."""
        for experiment, streaks_px in (("rate", STREAKS_PX), ("boresight", BORESIGHT_PX)):
            usual = self.rates_deg_s(streaks_px, experiment)
            for rate in self.chosen_rates_deg_s or usual:
                yield from self.at_rate(experiment, rate)

    def at_rate(self, experiment: str, rate_deg_s: float) -> Cells:
        """A pair of frames at a rate, of one of RATES."""
        return self.pair(experiment, "trial.rate_deg_s", rate_deg_s, RATES[experiment])

    def add_faster(self, cells: list[DatasheetCell], experiments: Iterable[str]) -> None:
        """Add a pair at twice the greatest rate of each experiment, one of RATES."""
        for name in experiments:
            rates = [one.levels["rate_deg_s"] for one in cells if one.experiment == name]
            cells += self.at_rate(name, 2 * max(rates))

    def sequences(self) -> Cells:
        """Frames of one unit at the scene's frame rate, at rest and at constant rates."""
        for rate in (0.0, *self.rates_deg_s(STREAKS_PX[:SEQUENCE_RATES])):
            for step in SEQUENCE:
                turn_deg = rate * step / self.scene.exposure.rate_hz
                settings = self.settings(turn_deg=turn_deg) | {"trial.rate_deg_s": rate}
                yield DatasheetCell("sequence", {"rate_deg_s": rate, "step": step}, settings)

    def tracked(self) -> Cells:
        """Pairs of frames in tracking mode, at constant rates and at accelerations; none without the mode.

        The prediction extrapolates the mean rate between the last two frames, and its change where the streaks tell it:
        an acceleration a displaces the next frame, t later, by a t^2 from the mean rate alone.
        """
        if not tracks(self.scene):
            return
        between_s = 1 / self.scene.exposure.rate_hz
        motions = {
            "rate_deg_s": self.rates_deg_s(TRACKED_STREAKS_PX),
            "acceleration_deg_s2": self.accelerations_deg_s2(MISSED_PX, between_s),
        }
        for key, values in motions.items():
            for value in values:
                yield from self.pair(
                    f"tracked {key}", f"trial.{key}", value, {"trial.tracked": TRACKED}
                )

    def magnitudes(self) -> Cells:
        """Pairs of frames with other limits of the tracker's catalog, under the stars."""
        if not self.under_stars:
            return
        for step in (0.0, *FAINTER):
            limit = self.scene.tracker.limit_mag + step
            if step > 0 and limit > scene_changes.catalog_end_mag(self.scene):
                continue
            yield from self.pair("magnitude", "tracker.limit_mag", limit)


# Run the experiments of a datasheet: write them as a study, run its missing trials, and read their results as arrays.


STUDY = "datasheet.yaml"
AXES = ("x_arcsec", "y_arcsec", "roll_arcsec")


class MeasuredFrames(NamedTuple):
    """The measured frames of a datasheet.

    Attributes
    ----------
    columns
        Results of the trials, (cells, fields) each
    scene_name
        Name or file of the scene, as it was given
    overrides
        Overrides of the command line
    spec
        Specification by which a trial can be run again
    """

    scene: Scene
    scene_name: str
    overrides: OverrideTexts
    size: Size
    designer: Designer
    cells: list[DatasheetCell]
    columns: dict[str, Array]
    spec: TrialSpec

    def rows(self, experiment: str, **levels: Any) -> CellRows:
        """Rows of the cells of an experiment that have these levels."""
        return [
            row
            for row, cell in enumerate(self.cells)
            if cell.experiment == experiment and levels.items() <= cell.levels.items()
        ]

    def levels(self, experiment: str, name: str) -> list[Any]:
        """The levels of an experiment, in order."""
        return list(
            dict.fromkeys(self.cells[row].levels[name] for row in self.rows(experiment))
        )

    def right(self, rows: CellRows) -> Bools:
        """(cells, fields) whether a frame was solved and is not false."""
        return (self.columns["solved"][rows] > 0) & ~self.false(rows)

    def false(self, rows: CellRows) -> Bools:
        """(cells, fields) whether a frame has a false attitude."""
        return self.columns["wrong"][rows] > 0

    def solved_at_all_rates(self) -> list[str]:
        """Experiments of RATES in which enough fields are right at the fastest rate, whose streak is in the field."""
        found = []
        for experiment in RATES:
            rate = max(self.levels(experiment, "rate_deg_s"))
            right = self.right(self.rows(experiment, rate_deg_s=rate)).all(axis=0)
            longest = self.designer.rates_deg_s(
                [scene_changes.side_px(self.scene)], experiment
            )[0]
            if right.mean() >= MOST_FAIL and 2 * rate <= longest:
                found.append(experiment)
        return found

    def errors(self, rows: CellRows) -> Floats:
        """(3, cells, fields) errors about the camera's axes, arcseconds; NaN for refused and false attitudes."""
        errors = np.stack([self.columns[name][rows] for name in AXES])
        return np.where(self.right(rows), errors, np.nan)


def attitudes(scene: Scene) -> Record:
    """Keys of the trial that bound the attitudes: under a dome, the tilt limit of the vehicle."""
    if scene.light.kind != "dome":
        return {}
    greatest = scene.vehicle.tilt_stop_deg if scene.vehicle.mount == "air_bearing" else 30.0
    return {"tilt_deg": [0.0, min(float(greatest), 30.0)]}


def measure(
    scene_name: str,
    scene: Scene,
    overrides: OverrideTexts,
    folder: Path,
    *,
    quick: bool = False,
    fields: int | None = None,
    least: int = MIN_FIELDS,
    rates_deg_s: Sequence[float] = (),
    workers: int | None = None,
    watch: Callable[[int], runner.Watch] | None = None,
) -> MeasuredFrames:
    """Run the missing trials of a scene's datasheet in a folder, and return all of them.

    Parameters
    ----------
    quick, fields
        Smaller experiments; number of fields, None for the usual one
    least
        Number of fields that must be solved: MIN_FIELDS, or MODEL_FIELDS for an error model
    rates_deg_s
        See `Designer`; without rates they double until MOST_FAIL of the fields fail
    watch
        Called with the number of trials; returns what is called after every batch

    Raises
    ------
    InputError
        Before the first trial for a scene without attitudes of single frames, too few fields, and a cell whose settings
        are not allowed; later for a cell whose trials fail.
    """
    check_scene(scene)
    usual = QUICK if quick else FULL
    size = usual if fields is None else usual._replace(fields=fields)
    purpose = "to fit and test a model" if least > MIN_FIELDS else "for the error terms"
    require_fields(size.fields, size.fields, least, f"too few {purpose}")
    designer = Designer(scene, size, rates_deg_s)
    cells = list(designer.cells())
    path = make_folder(folder) / STUDY
    engine = runner.ENGINES["serial" if workers == 1 else "pool"](workers, "")
    with closing(engine), store.writing(folder / store.STORE) as kept:
        # The rates that an earlier call has added.
        points = kept.points()[len(cells) :: 2]
        added = (str(point.levels.get("cell")).partition(" ")[0] for point in points)
        designer.add_faster(cells, (name for name in added if name in RATES))
        plan = planned(path, scene_name, designer, overrides, cells)
        runner.prepare_store(plan, kept, resume=kept.counts()["done"] > 0)
        while True:
            runner.run(plan, kept, engine, watch(plan.trials) if watch else None)
            run = read(plan, kept), plan.spec
            sheet = MeasuredFrames(scene, scene_name, overrides, size, designer, cells, *run)
            solved = [] if rates_deg_s else sheet.solved_at_all_rates()
            if not solved:
                return sheet
            designer.add_faster(cells, solved)
            plan = planned(path, scene_name, designer, overrides, cells)
            runner.begin_store(plan, kept)


def planned(
    path: Path,
    scene_name: str,
    designer: Designer,
    overrides: OverrideTexts,
    cells: list[DatasheetCell],
) -> Plan:
    """Write the study file of the cells and plan its trials. Raises InputError for settings that are not allowed."""
    scene = designer.scene
    settings = {key: parse_yaml(text)[1] for key, text in overrides.items() if key != "seed"}
    tree: Record = {
        "schema": 1,
        "title": f"Datasheet of {scene.title}",
        "scene": scene_name,
        "seed": scene.seed,
        **({"set": settings} if settings else {}),
        "trial": {"kind": "frames", **attitudes(scene)},
        "factors": {"cell": {"levels": {cell.name: cell.settings for cell in cells}}},
        "replicates": designer.size.fields,
        "responses": [
            "identified",
            "wrong",
            "refused",
            "cross_arcsec_rms",
            "roll_arcsec_rms",
        ],
    }
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=120)
    write_text(path, text)
    plan = make_plan(path, Study.model_validate(tree), tree["trial"], {}, text)
    for cell in cells:
        with errors_within(cell.name):
            resolve_point(plan.spec, cell.settings)
    return plan


def read(plan: Plan, kept: store.Store) -> dict[str, Array]:
    """The columns of all trials, (cells, fields). Raises InputError for a failed trial."""
    if failures := kept.failures():
        trial, error = failures[0]
        point: Point = plan.points[trial // plan.study.replicates]
        raise InputError(point.levels["cell"], error.strip().splitlines()[-1])
    return {
        name: values.reshape(len(plan.points), -1) for name, values in kept.columns().items()
    }
