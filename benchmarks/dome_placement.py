"""LED layouts compared at independent attitudes: patch boards, Fibonacci spiral, Poisson disk and optimized layout.

The last table of docs/findings/dome.md: AFIT's SimSat under its measured dome with the scene's camera and lever arm,
LEDS equal LEDs over the cap that any field within 30 degrees of tilt can reach.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.dome_identify import TILT_DEG, Case, trial
from benchmarks.timing import figure, verdict
from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.camera import Camera
from estimator.identification.led_index import build_dome_index
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.scene.sections import layouts
from skysim.scene.sections import leds as led_schema
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lab import build_lab
from skysim.sources.dome.layouts import fisher, optimize, registry
from skysim.sources.dome.surface import Surface, build_surface
from skysim.sources.photometry import Band
from skysim.tracking.onboard_model import calibration

Ints = NDArray[np.int64]

TEST_ATTITUDES = 100_000  # number of test attitudes
LEDS = 400
FRAMES = 1000  # for the tracker
NOISE_PX = 0.1  # centroid noise for the predicted sigmas
TAIL = 0.01  # fraction of the attitudes, the worst, that is averaged
MAX_OVERLAP = 0.5  # overlap above which two neighborhoods count as alike
ATTITUDE_SEED = 0xD03E  # seed of the test attitudes; no layout uses it
KINDS = ("patch boards", "Fibonacci", "Poisson disk", "optimized")


@dataclass(frozen=True)
class Setup:
    """Test geometry from the scene: inner surface, camera, lever arm, LED hardware, half-angle of the visible cap."""

    surface: Surface
    camera: Camera
    lever: Lever
    boards: layouts.PatchBoardsConfig
    led: led_schema.LedConfig
    band: Band
    cap_deg: float


@dataclass(frozen=True)
class Row:
    """Results for one layout.

    seen       : LEDs in a field: mean, minimum
    blind      : fraction of attitudes that see fewer than two LEDs, the minimum for an attitude
    roll_arcsec, cross_arcsec : sigma for NOISE_PX: median, mean of the worst TAIL, worst; infinite where blind
    alike      : fraction of neighborhoods that match another one in more than HALF of their LEDs
    found, ambiguous : fractions of the frames that the tracker identified, and called ambiguous
    wrong      : number of frames identified wrongly
    layout_s   : processor time to make the layout
    """

    layout: str
    count: int
    seen: tuple[float, int]
    blind: float
    roll_arcsec: tuple[float, float, float]
    cross_arcsec: tuple[float, float, float]
    alike: float
    found: float
    ambiguous: float
    wrong: int
    layout_s: float


def build_setup() -> Setup:
    """The test geometry of scene afit_simsat."""
    lab = build_lab(loader.load("afit_simsat"))
    light = lab.scene.light
    camera = calibration(lab.scene.camera)
    lever = Lever(np.array(lab.camera.mount.camera_body_m), lab.camera.mount.cam_from_body)
    assert isinstance(light, DomeConfig)
    assert isinstance(light.layout, layouts.PatchBoardsConfig)
    surface = build_surface(light.surface)
    wide = Setup(surface, camera, lever, light.layout, light.led, lab.camera.band, 40.0)
    reach_deg = float(
        np.degrees(optimize.field_reach_rad(optimized_config(wide, 3, 0), surface))
    )
    return Setup(surface, camera, lever, light.layout, light.led, lab.camera.band, reach_deg)


def optimized_config(setup: Setup, count: int, seed: int) -> layouts.OptimizedConfig:
    """Configuration of an optimized layout, with defaults for all optional keys."""
    half = (
        np.array([setup.camera.width_px, setup.camera.height_px]) / 2 / setup.camera.focal_px
    )
    return layouts.OptimizedConfig.model_validate(
        {
            "kind": "optimized",
            "cap_deg": setup.cap_deg,
            "count": count,
            "tilt_deg": TILT_DEG,
            "field_deg": np.degrees(2 * np.arctan(half)).tolist(),
            "camera": [f"{value} m" for value in setup.lever.camera_body_m],
            "spacing": "8 mm",
            "hardware_seed": seed,
        }
    )


def leds(setup: Setup, kind: str, count: int, seed: int) -> tuple[Floats, Ints | None]:
    """(count, 3) LED positions, m, and the board of each.

    The number of LEDs of patch boards and Poisson disks follows from their spacing, so the spacing is reduced until
    there are enough, and surplus LEDs are dropped at random.
    """
    cap = {"cap_deg": setup.cap_deg, "hardware_seed": seed}
    configs: list[layouts.Layout] = []
    if kind == "optimized":
        configs = [optimized_config(setup, count, seed)]
    elif kind == "Fibonacci":
        configs = [
            layouts.FibonacciConfig.model_validate(
                {"kind": "fibonacci", "count": count} | cap
            )
        ]
    area_m2 = 2 * np.pi * np.square(setup.surface.meet(np.zeros(3), np.eye(3)[2:])[0, 2])
    each_m2 = area_m2 * (1 - np.cos(np.radians(setup.cap_deg))) / count
    # Candidates with up to 50% more LEDs than asked for, in small steps; the first with enough of them is used.
    for density in np.linspace(1.0, 1.5, 51) if not configs else ():
        if kind == "patch boards":
            spacing_m = np.sqrt(each_m2 * np.mean(setup.boards.lit) / density)
            configs.append(setup.boards.model_copy(update=cap | {"spacing_m": spacing_m}))
        else:
            disk = {
                "kind": "poisson_disk",
                "spacing": f"{np.sqrt(0.66 * each_m2 / density)} m",
            }
            configs.append(layouts.PoissonDiskConfig.model_validate(disk | cap))
    candidates = (
        registry.LAYOUTS[config.kind](config, setup.surface, setup.led, setup.band)
        for config in configs
    )
    sources = next(candidate for candidate in candidates if len(candidate) >= count)
    selected = np.sort(np.random.default_rng(seed).permutation(len(sources))[:count])
    return sources.place[selected, :3], registry.board_of(configs[0], sources.id[selected])


def sigmas_arcsec(setup: Setup, place_m: Floats) -> tuple[Floats, Floats, Floats]:
    """(A,) sigma of roll, sigma across the boresight, both in arcseconds, and number of LEDs in the field.

    The A = FRESH attitudes are independent of any layout. The covariance is that of the rotation-only solution at the
    truth, (sum_i J_i^T J_i)^-1 sigma^2; body z is the boresight. Sigmas are infinite for fewer than two LEDs.
    """
    config = optimized_config(setup, len(place_m), 0)
    attitudes = optimize.sample_attitudes(
        config, TEST_ATTITUDES, np.random.default_rng(ATTITUDE_SEED)
    )
    total = fisher.total_information(place_m, attitudes, *optimize.camera_geometry(config))
    solved = total[:, 6] >= 2
    variance = np.full((TEST_ATTITUDES, 3), np.inf)
    # Unpack the six elements of the symmetric information matrix (xx, yy, zz, xy, xz, yz).
    matrix = total[solved][:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
    variance[solved] = np.linalg.inv(matrix).diagonal(axis1=1, axis2=2)
    unit = NOISE_PX / setup.camera.focal_px / ARCSEC_RAD
    return (
        unit * np.sqrt(variance[:, 2]),
        unit * np.sqrt(variance[:, :2].sum(axis=1)),
        total[:, 6],
    )


def summarize(each: Floats) -> tuple[float, float, float]:
    """Median, mean of the worst fraction TAIL, and maximum."""
    worst = np.sort(each)[-round(TAIL * len(each)) :]
    return float(np.median(each)), float(worst.mean()), float(worst[-1])


def tracker_results(
    setup: Setup, place_m: Floats, board: Ints | None, frames: int, seed: int
) -> NDArray[np.str_]:
    """(frames,) result of the tracker for each frame, with equal LEDs and the noise and map errors of `Case`."""
    case = Case("placement")
    rng = np.random.default_rng(seed)
    assumed_m = place_m + case.assumed_m * rng.standard_normal(place_m.shape)
    led_map = LedMap(
        np.arange(len(place_m)),
        assumed_m,
        np.zeros(3),
        np.ones(3),
        board,
        sigma_m=case.assumed_m,
    )
    dome = build_dome_index(led_map, setup.lever, setup.camera)
    outcomes = [
        trial(case, place_m, setup.lever, setup.camera, dome, rng)[0] for _ in range(frames)
    ]
    return np.array([result.split(":")[0] for result in outcomes])


def row(setup: Setup, kind: str, count: int, seed: int, frames: int) -> Row:
    """Make and evaluate one layout."""
    begin = time.process_time()
    place_m, board = leds(setup, kind, count, seed)
    layout_s = time.process_time() - begin
    roll, cross, seen = sigmas_arcsec(setup, place_m)
    ambiguity = optimize.layout_ambiguity(optimized_config(setup, count, seed), place_m)
    outcomes = tracker_results(setup, place_m, board, frames, seed)
    return Row(
        kind,
        count,
        (float(seen.mean()), int(seen.min())),
        float(np.mean(seen < 2)),
        summarize(roll),
        summarize(cross),
        float(np.mean(ambiguity.fraction > MAX_OVERLAP)),
        float(np.mean(outcomes == "identified")),
        float(np.mean(outcomes == "ambiguous")),
        int(np.sum(outcomes == "WRONG")),
        layout_s,
    )


def measure(count: int = FRAMES, seed: int = 1) -> list[dict[str, Any]]:
    """The results of every kind of layout with LEDS LEDs, with `count` frames for the tracker."""
    setup = build_setup()
    return [
        one for kind in KINDS for one in rows_of(row(setup, kind, LEDS, seed, count), count)
    ]


def rows_of(one: Row, frames: int) -> list[dict[str, Any]]:
    """The rows of one layout. Sigmas are infinite if an attitude sees fewer than two LEDs."""
    what = f"{one.count} LEDs"
    tracked = f"{frames} frames"
    name = one.layout
    parts = ("median", f"worst {TAIL:.0%}", "worst")
    return [
        figure(f"{name}: LEDs seen, mean", one.seen[0], "", what),
        figure(f"{name}: LEDs seen, least", one.seen[1], "", what),
        *(
            figure(f"{name}: {axis}, {part}", sigma, "arcsec", what)
            for axis, sigmas in (("roll", one.roll_arcsec), ("cross", one.cross_arcsec))
            for part, sigma in zip(parts, sigmas, strict=True)
        ),
        figure(f"{name}: fields alike", 100 * one.alike, "%", what),
        figure(f"{name}: ambiguous", 100 * one.ambiguous, "%", tracked),
        figure(f"{name}: identified", 100 * one.found, "%", tracked),
        verdict(f"{name}: wrong", one.wrong, "frames", tracked, 0),
        figure(f"{name}: made in", one.layout_s, "s of CPU", what),
    ]
