"""LED layouts compared at independent attitudes: patch boards, Fibonacci spiral, Poisson disc and optimized layout.

`python -m benchmarks.placement [LEDS [FRAMES [SEED]]]` prints the table of docs/findings/dome.md: AFIT's SimSat under
its measured dome with the scene's camera and lever arm, LEDS equal LEDs over the cap that any field within 30 degrees
of tilt can reach, and FRAMES frames for the tracker. `compare` returns its rows.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.dome_identify import TILT_DEG, Case, trial
from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.camera import Camera
from estimator.identification.leds.index import sight_of
from skysim.core.types import Floats
from skysim.core.units import ARCSEC_RAD
from skysim.scene import leds as led_schema
from skysim.scene import loader
from skysim.scene.light import DomeConfig
from skysim.simulation import testbed
from skysim.sources.dome import layout
from skysim.sources.dome.placement import fisher, optimize
from skysim.sources.dome.surface import Inside, build_surface
from skysim.sources.photometry import Band
from skysim.tracking.onboard_model import calibration

Ints = NDArray[np.int64]

FRESH = 100_000  # number of test attitudes
ASKED = (400, 1000, 1)  # default arguments: LEDs, frames for the tracker, seed
NOISE_PX = 0.1  # centroid noise for the predicted sigmas
TAIL = 0.01  # fraction of the attitudes, the worst, that is averaged
HALF = 0.5  # overlap above which two neighborhoods count as alike
SEEN_BY_CHANCE = 0xD03E  # seed of the test attitudes; no layout uses it
KINDS = ("patch boards", "Fibonacci", "Poisson disc", "optimised")


@dataclass(frozen=True)
class Bench:
    """Test geometry from the scene: inner surface, camera, lever arm, LED hardware, half-angle of the visible cap."""

    inside: Inside
    camera: Camera
    lever: Lever
    boards: led_schema.PatchBoardsConfig
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
    made_s     : processor time to make the layout
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
    made_s: float


def bench() -> Bench:
    """The test geometry of scene afit_simsat."""
    lab = testbed.build_testbed(loader.load("afit_simsat"))
    light, camera = lab.scene.light, calibration(lab.scene.camera)
    lever = Lever(np.array(lab.mount.camera_body_m), lab.mount.cam_from_body)
    assert isinstance(light, DomeConfig)
    assert isinstance(light.layout, led_schema.PatchBoardsConfig)
    inside = build_surface(light.surface)
    known = Bench(inside, camera, lever, light.layout, light.led, lab.band, 40.0)
    reach_deg = float(np.degrees(optimize.reach_rad(wish(known, 3, 0), inside)))
    return Bench(inside, camera, lever, light.layout, light.led, lab.band, reach_deg)


def wish(of: Bench, count: int, seed: int) -> led_schema.OptimisedConfig:
    """Configuration of an optimized layout, with defaults for all optional keys."""
    half = np.array([of.camera.width_px, of.camera.height_px]) / 2 / of.camera.focal_px
    return led_schema.OptimisedConfig.model_validate(
        {
            "kind": "optimised",
            "cap_deg": of.cap_deg,
            "count": count,
            "tilt_deg": TILT_DEG,
            "field_deg": np.degrees(2 * np.arctan(half)).tolist(),
            "camera": [f"{one} m" for one in of.lever.camera_body_m],
            "spacing": "8 mm",
            "hardware_seed": seed,
        }
    )


def leds(of: Bench, kind: str, count: int, seed: int) -> tuple[Floats, Ints | None]:
    """(count, 3) LED positions, m, and the board of each.

    The number of LEDs of patch boards and Poisson discs follows from their spacing, so the spacing is reduced until
    there are enough, and surplus LEDs are dropped at random.
    """
    cap = {"cap_deg": of.cap_deg, "hardware_seed": seed}
    parts: list[led_schema.Layout] = []
    if kind == "optimised":
        parts = [wish(of, count, seed)]
    elif kind == "Fibonacci":
        parts = [led_schema.FibonacciConfig.model_validate({"kind": "fibonacci", "count": count} | cap)]
    area_m2 = 2 * np.pi * np.square(of.inside.meet(np.zeros(3), np.eye(3)[2:])[0, 2])
    each_m2 = area_m2 * (1 - np.cos(np.radians(of.cap_deg))) / count
    # Candidates with up to 50% more LEDs than asked for, in small steps; the first with enough of them is used.
    for more in np.linspace(1.0, 1.5, 51) if not parts else ():
        if kind == "patch boards":
            spacing_m = np.sqrt(each_m2 * np.mean(of.boards.lit) / more)
            parts.append(of.boards.model_copy(update=cap | {"spacing_m": spacing_m}))
        else:
            disc = {"kind": "poisson_disc", "spacing": f"{np.sqrt(0.66 * each_m2 / more)} m"}
            parts.append(led_schema.PoissonDiscConfig.model_validate(disc | cap))
    lit = (layout.LAYOUTS[part.kind](part, of.inside, of.led, of.band) for part in parts)
    sources = next(some for some in lit if len(some) >= count)
    kept = np.sort(np.random.default_rng(seed).permutation(len(sources))[:count])
    return sources.place[kept, :3], layout.board_of(parts[0], sources.id[kept])


def sigmas_arcsec(of: Bench, place_m: Floats) -> tuple[Floats, Floats, Floats]:
    """(A,) sigma of roll, sigma across the boresight, both in arcseconds, and number of LEDs in the field.

    The A = FRESH attitudes are independent of any layout. The covariance is that of the rotation-only solution at the
    truth, (sum_i J_i^T J_i)^-1 sigma^2; body z is the boresight. Sigmas are infinite for fewer than two LEDs.
    """
    part = wish(of, len(place_m), 0)
    fresh = optimize.attitudes(part, FRESH, np.random.default_rng(SEEN_BY_CHANCE))
    total = fisher.total_information(place_m, fresh, *optimize.camera(part))
    solved, variance = total[:, 6] >= 2, np.full((FRESH, 3), np.inf)
    # Unpack the six elements of the symmetric information matrix (xx, yy, zz, xy, xz, yz).
    matrix = total[solved][:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
    variance[solved] = np.linalg.inv(matrix).diagonal(axis1=1, axis2=2)
    unit = NOISE_PX / of.camera.focal_px / ARCSEC_RAD
    return unit * np.sqrt(variance[:, 2]), unit * np.sqrt(variance[:, :2].sum(axis=1)), total[:, 6]


def summed(each: Floats) -> tuple[float, float, float]:
    """Median, mean of the worst fraction TAIL, and maximum."""
    worst = np.sort(each)[-round(TAIL * len(each)) :]
    return float(np.median(each)), float(worst.mean()), float(worst[-1])


def verdicts(of: Bench, place_m: Floats, board: Ints | None, frames: int, seed: int) -> NDArray[np.str_]:
    """(frames,) result of the tracker for each frame, with equal LEDs and the noise and map errors of `Case`."""
    case, rng = Case("placement"), np.random.default_rng(seed)
    believed_m = place_m + case.believed_m * rng.standard_normal(place_m.shape)
    known = LedMap(
        np.arange(len(place_m)), believed_m, np.zeros(3), np.ones(3), board, sigma_m=case.believed_m
    )
    sight = sight_of(known, of.lever, of.camera)
    came = [trial(case, place_m, of.lever, of.camera, sight, rng)[0] for _ in range(frames)]
    return np.array([one.split(":")[0] for one in came])


def row(of: Bench, kind: str, count: int, seed: int, frames: int) -> Row:
    """Make and evaluate one layout."""
    begin = time.process_time()
    place_m, board = leds(of, kind, count, seed)
    made_s = time.process_time() - begin
    roll, cross, seen = sigmas_arcsec(of, place_m)
    like, came = optimize.alike(wish(of, count, seed), place_m), verdicts(of, place_m, board, frames, seed)
    return Row(
        kind,
        count,
        (float(seen.mean()), int(seen.min())),
        float(np.mean(seen < 2)),
        summed(roll),
        summed(cross),
        float(np.mean(like.share > HALF)),
        float(np.mean(came == "identified")),
        float(np.mean(came == "ambiguous")),
        int(np.sum(came == "WRONG")),
        made_s,
    )


def compare(count: int, frames: int, seed: int) -> Iterator[Row]:
    """Yield the results for every kind of layout with `count` LEDs."""
    of = bench()
    yield from (row(of, kind, count, seed, frames) for kind in KINDS)


def printed(one: Row) -> str:
    """A row of the table in the docs."""
    arcsec = ["—" if np.isinf(value) else f"{value:.3g}" for value in one.roll_arcsec + one.cross_arcsec]
    cells = [
        f"{one.count:,} {one.layout}",
        f"{one.seen[0]:.1f} ({one.seen[1]})",
        ", ".join(arcsec[:3]),
        ", ".join(arcsec[3:]),
        f"{100 * one.alike:.1f} %",
        f"{100 * one.ambiguous:.1f} %",
        f"{100 * one.found:.1f} %",
        f"{one.wrong}",
        f"{one.made_s:.1f} s",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    print(
        "| LEDs | seen (min) | roll: median, worst 1 %, worst | cross | alike | ambiguous | found | wrong | made |"
    )
    print("|---" * 9 + "|")
    told = [int(word) for word in sys.argv[1:]]
    for one in compare(*told, *ASKED[len(told) :]):
        print(printed(one), flush=True)
