"""Lost-in-space identification on many workloads, from centroids and magnitudes, beside peers and an oracle.

Success, wrong attitudes and time of ours, and of the peers on the same centroids (`peers`): tetra3rs and cedar. The sky
is Hipparcos to the workload's limiting magnitude, without the fainter of any two stars closer than 30". Attitudes are
uniform over all rotations. A star's magnitude has an error of 0.25 (1 sigma); a false star's is drawn from the catalog.
The oracle solves the attitude from the true identities of all true stars and needs at least three. A solution is
wrong if it is more than 10' off, unless the oracle's is too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks import peers
from benchmarks.timing import figure, verdict
from estimator.attitude.solvers import quest
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints
from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.constants import ARCSEC_RAD
from skysim.core.paths import CATALOGS
from skysim.results.metrics import WRONG_RAD
from skysim.sources import star_archives

DOUBLES_RAD = 30 * ARCSEC_RAD
MAGNITUDE_SIGMA = 0.25
DEEP = "hipparcos_hp7.5"
PEERS = ("tetra3rs", "cedar")
# Greatest error whatever is claimed, and in claimed standard deviations beyond it
CLAIMED_RAD = 30 * ARCSEC_RAD
CLAIMED_SIGMA = 5


@dataclass(frozen=True)
class Workload:
    """A camera, its limiting magnitude, and the disturbances of its fields.

    fov_deg       : (2,) field of view, width and height; width_px pixels wide, with square pixels
    brightest     : maximum number of centroids; false_share : fraction of the centroids that are false, after this cut
    false, missing: number of false lights, and fraction of the stars not detected
    false_brighter: whether every false light is brighter than any star
    lattice       : number of hot pixels on each side of a square lattice over the whole field, at whole pixels
    bar_percent, bar_ms : least success and greatest median time that we aim for
    focal_error   : relative error of the tracker's focal length; focal_uncertainty : that the tracker assumes
    clumps        : number of clumps of false lights, each CLUMP of the field's width; 0: all over the field
    faint         : whether the false lights are fainter stars than the catalog's, in numbers that grow as MAG_SLOPE
    milky_way     : share of the false lights in a band across the field
    doubled_px    : (2,) least and greatest distance of a second image of every star; () without
    ghost         : whether all second images of a frame have the same offset
    told_px       : claimed error of a centroid; None: the true one
    default       : whether the tracker has its default settings
    """

    name: str
    fov_deg: tuple[float, float]
    width_px: int
    limit_mag: float
    noise_px: float
    brightest: int = 1000
    false_share: float = 0.0
    false: int = 0
    missing: float = 0.0
    false_brighter: bool = False
    lattice: int = 0
    focal_error: float = 0.0
    focal_uncertainty: float = 0.0
    clumps: int = 0
    faint: bool = False
    milky_way: float = 0.0
    doubled_px: tuple[float, ...] = ()
    ghost: bool = False
    told_px: float | None = None
    default: bool = False
    bar_percent: float = 0.0
    bar_ms: float = np.inf

    @property
    def camera(self) -> Camera:
        """The pinhole camera with this field of view."""
        width, height = np.tan(np.radians(self.fov_deg) / 2)
        height_px = round(self.width_px * float(height / width))
        return Camera.from_fov(self.width_px, height_px, float(np.radians(self.fov_deg[0])))


PTASE_PX = 1024
SHEFEX = (14.87, 11.15)
DENSE = ((17, 13), 1024, 6.0, 0.2)
NARROW = (6, 6), 1024, 7.5, 0.2
WORKLOADS = (
    Workload(
        "PTASE",
        (20, 20),
        PTASE_PX,
        6.0,
        3 * ARCSEC_RAD * PTASE_PX / 2 / np.tan(np.radians(10)),
    ),
    Workload("SHEFEX", SHEFEX, 659, 5.75, 0.1, brightest=15, bar_percent=100, bar_ms=0.05),
    Workload("SHEFEX, half false", SHEFEX, 659, 5.75, 0.1, brightest=15, false_share=0.5),
    Workload(
        "SHEFEX, .5 px, a fifth false", SHEFEX, 659, 5.75, 0.5, brightest=15, false_share=0.2
    ),
    Workload("hard, V < 6.5", (10, 7.5), 1024, 6.5, 1.0, false=3, missing=0.2),
    Workload("hard, V < 7", (10, 7.5), 1024, 7.0, 1.0, false=3, missing=0.2),
    Workload("17 x 13 deg, half false", *DENSE, false_share=0.5, bar_percent=99.5),
    Workload("17 x 13 deg, 70 % false", *DENSE, false_share=0.7, bar_percent=97, bar_ms=5),
    Workload(
        "the same, half false, brighter",
        *DENSE,
        false_share=0.5,
        false_brighter=True,
        bar_percent=98,
        bar_ms=20,
    ),
    Workload("6 x 6 deg, 70 % false", *NARROW, false_share=0.7, bar_percent=92),
    Workload(
        "6 x 6 deg, 25 hot pixels, a lattice", *NARROW, lattice=5, bar_percent=98, bar_ms=10
    ),
    Workload(
        "the same, brighter than any star",
        *NARROW,
        lattice=5,
        false_brighter=True,
        bar_percent=98,
        bar_ms=10,
    ),
    Workload(
        "35 x 20 deg, 70 % false", (35, 20), 1280, 5.5, 0.2, false_share=0.7, bar_percent=99
    ),
    Workload(
        "23 x 23 deg, 70 % false", (23, 23), 1024, 5.5, 0.2, false_share=0.7, bar_percent=97
    ),
    Workload(
        "SHEFEX, focal known to 5 %, off 5 %",
        SHEFEX,
        659,
        5.75,
        0.1,
        focal_error=0.05,
        focal_uncertainty=0.05,
        bar_percent=99.5,
        bar_ms=1,
    ),
    Workload(
        "17 x 13 deg, half false, the same",
        *DENSE,
        false_share=0.5,
        focal_error=0.05,
        focal_uncertainty=0.05,
    ),
    Workload(
        "SHEFEX, focal off 1 %, assumed exact",
        SHEFEX,
        659,
        5.75,
        0.1,
        focal_error=0.01,
        bar_percent=99.5,
    ),
    Workload("17 x 13 deg, half false, the same", *DENSE, false_share=0.5, focal_error=0.01),
)

CLUMP = 0.02  # standard deviation of a clump, in widths of the field
BAND = 0.15  # standard deviation of the band of the Milky Way, in widths of the field
MAG_SLOPE = 0.5  # log10 of the number of stars to a magnitude, per magnitude
FIELD_6 = (6, 6), 1024, 7.5, 0.2
FIELD_15 = SHEFEX, 659, 5.75, 0.1
FIELD_24 = (24, 18), 1280, 6.0, 0.15
FIELD_60 = (60, 40), 1600, 5.0, 0.2
HOSTILE = (
    Workload("6 deg, clean", *FIELD_6, default=True, bar_percent=99.5),
    Workload("SHEFEX, clean", *FIELD_15, default=True, bar_percent=99.5),
    Workload("24 deg, clean", *FIELD_24, default=True, bar_percent=99.5),
    Workload("60 deg, clean", *FIELD_60, default=True, bar_percent=99.5),
    *(
        Workload(
            f"{name}, every star twice, {how}",
            *field,
            doubled_px=(1, 5),
            ghost=how == "ghost",
            default=True,
            bar_percent=98,
        )
        for name, field in (("6 deg", FIELD_6), ("SHEFEX", FIELD_15), ("24 deg", FIELD_24))
        for how in ("at random", "ghost")
    ),
    Workload(
        "6 deg, 5,000 lights", *FIELD_6, false=5000, faint=True, default=True, bar_percent=98
    ),
    Workload(
        "24 deg, 5,000 lights",
        *FIELD_24,
        false=5000,
        faint=True,
        default=True,
        bar_percent=98,
    ),
    Workload(
        "60 deg, 5,000 lights",
        *FIELD_60,
        false=5000,
        faint=True,
        default=True,
        bar_percent=98,
    ),
    Workload(
        "6 deg, Milky Way",
        *FIELD_6,
        false=1500,
        faint=True,
        milky_way=0.7,
        default=True,
        bar_percent=95,
    ),
    Workload(
        "6 deg, 90 false in 3 clumps",
        *FIELD_6,
        false=90,
        clumps=3,
        default=True,
        bar_percent=98,
    ),
    Workload(
        "SHEFEX, 90 false in 3 clumps",
        *FIELD_15,
        false=90,
        clumps=3,
        default=True,
        bar_percent=98,
    ),
    Workload(
        "24 deg, 90 false in 3 clumps",
        *FIELD_24,
        false=90,
        clumps=3,
        default=True,
        bar_percent=98,
    ),
    Workload(
        "60 deg, 90 false in 3 clumps",
        *FIELD_60,
        false=90,
        clumps=3,
        default=True,
        bar_percent=98,
    ),
    Workload(
        "6 deg, 25 hot pixels", *FIELD_6, lattice=5, default=True, bar_percent=98, bar_ms=10
    ),
    Workload(
        "SHEFEX, 25 hot pixels", *FIELD_15, lattice=5, default=True, bar_percent=98, bar_ms=10
    ),
    Workload("6 deg, 70 % false", *FIELD_6, false_share=0.7, default=True, bar_percent=96),
    Workload("24 deg, 70 % false", *FIELD_24, false_share=0.7, default=True, bar_percent=96),
    Workload(
        "6 deg, focal off 1 %, assumed exact",
        *FIELD_6,
        focal_error=0.01,
        default=True,
        bar_percent=99.5,
    ),
    Workload(
        "6 deg, focal known to 5 %, off 5 %",
        *FIELD_6,
        focal_error=0.05,
        focal_uncertainty=0.05 / 1.05,
        default=True,
        bar_percent=99.5,
    ),
    Workload(
        "6 deg, focal known to 5 %, off 3 %",
        *FIELD_6,
        focal_error=-0.03,
        focal_uncertainty=0.05 / 1.05,
        default=True,
        bar_percent=99.5,
    ),
    Workload(
        "SHEFEX, focal known to 5 %, off 5.25 %",
        *FIELD_15,
        focal_error=0.0525,
        focal_uncertainty=0.05 / 1.05,
        default=True,
        bar_percent=99,
    ),
    Workload(
        "24 deg, focal known to 5 %, off -5.25 %",
        *FIELD_24,
        focal_error=-0.0525,
        focal_uncertainty=0.05 / 1.05,
        default=True,
        bar_percent=99,
    ),
    Workload(
        "SHEFEX, sigma 0.5 px, told 0.02",
        SHEFEX,
        659,
        5.75,
        0.5,
        told_px=0.02,
        default=True,
        bar_percent=99,
    ),
    Workload(
        "24 deg, sigma 0.5 px, told 0.02",
        (24, 18),
        1280,
        6.0,
        0.5,
        told_px=0.02,
        default=True,
        bar_percent=99,
    ),
    Workload(
        "6 deg, sigma 0.5 px, told 0.02",
        (6, 6),
        1024,
        7.5,
        0.5,
        told_px=0.02,
        default=True,
        bar_percent=99,
    ),
    Workload("SHEFEX, half false", *FIELD_15, false_share=0.5, default=True, bar_percent=98),
    Workload(
        "17 x 13 deg, half false", *DENSE, false_share=0.5, default=True, bar_percent=98
    ),
    Workload("SHEFEX, no star", *FIELD_15, missing=1.0, false=30, default=True, bar_ms=20),
    Workload("6 deg, no star", *FIELD_6, missing=1.0, false=80, default=True, bar_ms=20),
    Workload("24 deg, no star", *FIELD_24, missing=1.0, false=200, default=True, bar_ms=20),
)


@dataclass(frozen=True)
class Field:
    """One frame: centroids, brightest first, true attitude, and the star of each centroid (-1: false)."""

    centroids: Centroids
    cam_from_icrs: Rotation
    star: Ints


def sky(limit_mag: float) -> catalog.StarCatalog:
    """The stars to a limiting magnitude, without close doubles. Builds the deeper catalog if it does not exist yet."""
    path = CATALOGS / f"{DEEP}.ecsv"
    if not path.is_file():
        star_archives.build_hipparcos(7.5, path)
    stars = catalog.brighter_than(catalog.read(path), limit_mag)
    near = cKDTree(stars.vectors).query_pairs(
        2 * np.sin(DOUBLES_RAD / 2), output_type="ndarray"
    )
    fainter = near.max(axis=1)  # rows are sorted by magnitude
    return stars.take(np.setdiff1d(np.arange(len(stars)), fainter))


def fields(
    work: Workload, stars: catalog.StarCatalog, count: int, seed: int
) -> Iterator[Field]:
    """Random frames of a workload."""
    for n in range(count):
        yield field(work, stars, np.random.default_rng([seed, n]))


def field(work: Workload, stars: catalog.StarCatalog, rng: np.random.Generator) -> Field:
    """One random frame."""
    camera = work.camera
    truth = Rotation.random(rng=rng)
    xy = camera.pixels(truth.apply(stars.vectors))
    row = np.flatnonzero(camera.contains(np.nan_to_num(xy, nan=-1e9)))
    row = row[rng.random(len(row)) >= work.missing]
    mag = stars.v_mag[row] + MAGNITUDE_SIGMA * rng.standard_normal(len(row))
    # With a limit on the centroids, the false share counts within the limit; 1000 means no limit.
    true = round(work.brightest * (1 - work.false_share)) if work.brightest < 1000 else 1000
    row = row[np.argsort(mag)[:true]]
    mag = np.sort(mag)[:true]
    false = work.false + round(len(row) * work.false_share / (1 - work.false_share))
    detected = xy[row] + work.noise_px * rng.standard_normal((len(row), 2))
    if work.doubled_px:
        second = second_images(work, len(row), rng)
        detected = np.concatenate([detected, detected + second])
        mag = np.concatenate([mag, mag + 0.1 * rng.standard_normal(len(mag))])
        row = np.concatenate([row, row])
    false_xy = false_places(work, false, rng)
    false = len(false_xy)
    xy = np.concatenate([detected, false_xy])
    mag = np.concatenate([mag, false_magnitudes(work, stars, mag.min(initial=0), false, rng)])
    order = np.argsort(mag)
    sigma = np.full(len(xy), work.noise_px if work.told_px is None else work.told_px)
    star = np.concatenate([row, np.full(false, -1)])
    return Field(Centroids(xy[order], sigma, 10 ** (-0.4 * mag[order])), truth, star[order])


def second_images(work: Workload, count: int, rng: np.random.Generator) -> Floats:
    """(count, 2) offsets of the second images, pixels: the same for all with `ghost`."""
    shape = (1, 1) if work.ghost else (count, 1)
    length = rng.uniform(*work.doubled_px, shape)
    angle = rng.uniform(0, 2 * np.pi, shape)
    return np.broadcast_to(length * np.hstack([np.cos(angle), np.sin(angle)]), (count, 2))


def false_places(work: Workload, count: int, rng: np.random.Generator) -> Floats:
    """(count, 2) pixels of the false lights: a lattice, clumps, a band, or anywhere."""
    size = np.array([work.camera.width_px, work.camera.height_px])
    if work.lattice:
        steps = (np.arange(work.lattice) + 0.5) / work.lattice
        x, y = np.meshgrid(*np.round(steps * size[:, None]))
        return np.column_stack([x.ravel(), y.ravel()])
    places = rng.uniform(-0.5, size - 0.5, (count, 2))
    if work.clumps:
        middle = rng.uniform(0.1 * size, 0.9 * size, (work.clumps, 2))
        places = middle[np.arange(count) % work.clumps]
        places = places + CLUMP * size[0] * rng.standard_normal((count, 2))
    if work.milky_way:
        # Distance from a line through the middle of the field, for a part of the lights.
        angle = rng.uniform(0, np.pi)
        across = np.array([np.cos(angle), np.sin(angle)])
        wanted = BAND * size[0] * rng.standard_normal(count)
        moved = places + ((wanted - (places - size / 2) @ across)[:, None]) * across
        inside = (moved > 0).all(axis=1) & (moved < size - 1).all(axis=1)
        in_band = inside & (rng.random(count) < work.milky_way)
        places = np.where(in_band[:, None], moved, places)
    return np.clip(places, 0, size - 1)


def false_magnitudes(
    work: Workload,
    stars: catalog.StarCatalog,
    brightest: float,
    count: int,
    rng: np.random.Generator,
) -> Floats:
    """(count,) magnitudes of the false lights: the catalog's, brighter than any star, or those of fainter stars."""
    if work.faint:
        # The cumulative number grows as 10^(MAG_SLOPE mag) over three magnitudes.
        share = rng.uniform(10 ** (-3 * MAG_SLOPE), 1, count)
        return stars.v_mag.max() + 3 + np.log10(share) / MAG_SLOPE
    shift = stars.v_mag.max() - brightest if work.false_brighter else 0
    return rng.choice(stars.v_mag, count) - shift


def oracle(work: Workload, stars: catalog.StarCatalog, frame: Field) -> Rotation | None:
    """The attitude from the true identities; None with fewer than three stars."""
    known = frame.star >= 0
    if known.sum() < 3:
        return None
    rays = work.camera.rays(frame.centroids.xy_px[known])
    sigma = np.full(len(rays), work.noise_px / work.camera.focal_px)
    return quest(rays, stars.vectors[frame.star[known]], sigma)


Solve = Callable[[Field], Attitude | Rotation | None]


def ours(work: Workload, stars: catalog.StarCatalog, identifier: str) -> Solve:
    """The skysim star tracker with one of its identifiers."""
    settings = (
        Settings(identifier=identifier)
        if work.default
        else Settings(
            identifier=identifier,
            centroid_sigma_px=0.0,
            field_stars=1e9,
            merge_px=0.0,
            zero_point_mag=0.0,
        )
    )
    camera = work.camera.zoomed(1 + work.focal_error)
    tracker = StarTracker(
        camera, stars, stars.vectors, settings, 1.05 * work.focal_uncertainty
    )
    return lambda frame: tracker.solve_centroids(frame.centroids)


def solver(work: Workload, stars: catalog.StarCatalog, name: str) -> Solve | None:
    """A peer by name, else ours with that identifier; None for a peer that is not installed or not made for it."""
    camera = work.camera.zoomed(1 + work.focal_error)
    uncertainty = 1.05 * work.focal_uncertainty
    if name == "tetra3rs":
        solve = peers.tetra3rs(camera, work.noise_px, uncertainty)
    elif name == "cedar":
        solve = peers.cedar(camera, uncertainty)
    else:
        return ours(work, stars, name)
    return None if solve is None else lambda frame: solve(frame.centroids)


def is_right(answer: Attitude | Rotation | None, error: Floats, work: Workload) -> bool:
    """Whether an error, a rotation vector, is small; of hostile fields also within five of its standard deviations."""
    size = float(np.linalg.norm(error))
    small = size < WRONG_RAD
    if (
        not small
        or not work.default
        or size < CLAIMED_RAD
        or not isinstance(answer, Attitude)
    ):
        return bool(small)
    return bool(error @ np.linalg.solve(answer.covariance_rad2, error) < CLAIMED_SIGMA**2)


def score(work: Workload, count: int, seed: int, name: str) -> dict[str, float] | None:
    """Percent of found, wrong and possible fields, median and 99 % of the times in ms, and seconds to build."""
    stars = sky(work.limit_mag)
    begin = time.perf_counter()
    solve = solver(work, stars, name)
    if solve is None:
        return None
    build_s = time.perf_counter() - begin
    ms = []
    solved = 0
    wrong = 0
    possible = 0
    for n, frame in enumerate(fields(work, stars, count, seed)):
        if n == 0:
            solve(frame)  # compiles
        best = oracle(work, stars, frame)
        possible += best is not None
        begin = time.perf_counter()
        answer = solve(frame)
        ms.append(1e3 * (time.perf_counter() - begin))
        cam_from_icrs = answer.cam_from_ref if isinstance(answer, Attitude) else answer
        if cam_from_icrs is None:
            continue
        right = is_right(
            answer, (cam_from_icrs * frame.cam_from_icrs.inv()).as_rotvec(), work
        )
        oracle_right = (
            best is not None and (best * frame.cam_from_icrs.inv()).magnitude() < WRONG_RAD
        )
        solved += right
        wrong += not right and (oracle_right or best is None)
    found, mistaken, oracles = (100 * part / count for part in (solved, wrong, possible))
    middle, late = np.percentile(ms, [50, 99])
    return {
        "found": found,
        "wrong": mistaken,
        "oracle": oracles,
        "ms": middle,
        "p99": late,
        "build": build_s,
    }


def measure(count: int = 200, seed: int = 1) -> list[dict[str, Any]]:
    """Fields found and median times of all workloads beside the best of the peers; wrong answers of ours."""
    rows = []
    for number, work in enumerate((*WORKLOADS, *HOSTILE)):
        scored = {name: score(work, count, seed, name) for name in ("default", *PEERS)}
        mine = scored["default"]
        theirs = {name: scored[name] for name in PEERS if scored[name] is not None}
        assert mine is not None
        best = max(theirs, key=lambda name: theirs[name]["found"], default=None)
        for key, unit, bar, least in (
            ("found", "%", work.bar_percent, True),
            ("wrong", "%", 0.0, False),
            ("ms", "ms", work.bar_ms, False),
        ):
            row = verdict(
                f"{number + 1}. {work.name}: {key}", mine[key], unit, best or "-", bar, least
            )
            rows.append(row | {"peer_value": theirs[best][key] if best else None})
        rows += [
            figure(f"{number + 1}. {work.name}: oracle", mine["oracle"], "%"),
            figure(f"{number + 1}. {work.name}: ms, 99 %", mine["p99"], "ms"),
        ]
    return rows
