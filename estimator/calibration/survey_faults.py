"""Faults of a dome found by its survey: LEDs that are dark, far from their place in the list, or exchanged.

`names` first gives each light the name that place and brightness have together, so that what the list's errors explain
is no fault.

A fault is reported only if chance would make it in fewer than FALSE_ALARMS surveys of a dome without one, all LEDs
together (Bonferroni: each of N LEDs is tested at FALSE_ALARMS / N).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import gammainccinv

from estimator.attitude.dome_map import LedMap, Lever, on_surface, project
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints
from estimator.core.constants import SIGMA_PER_MAD

Mask = NDArray[np.bool_]
FALSE_ALARMS = 1e-3  # mean number of surveys with a false alarm of one kind
MIN_FRAMES = 3  # that must show a light, or fail to show it
CHI2_MEDIAN = 2.366  # of three degrees of freedom
TINY_M2 = 1e-18  # keeps a variance of 0 from a division
SURFACE_SIGMA_M = (
    0.005  # of the assumed surface, for the distance of a light seen from one side only
)
GATE = 5.0  # standard deviations of a ray that belongs to a light
MIN_SCATTER = 0.02  # of the logarithm of an LED's light
CHANCE = 0.02  # of a light missed although it is on, or seen although it is off, at least
FORBIDDEN = 1e7  # cost of a name that is not allowed


@dataclass(frozen=True, slots=True)
class HeldFrames:
    """The attitudes of a survey's F frames, and the model that it found."""

    camera: Camera
    leds: LedMap
    lever: Lever
    body_from_lab: Rotation

    def shown(self, margin_px: float | Floats, apart_px: float) -> Mask:
        """(F, N) LEDs that a frame must show if they shine: not nearer to the edge than a margin, or to another LED.

        Parameters
        ----------
        margin_px
            One, or (N,) of each LED
        apart_px
            Least distance from other LEDs, whose images may merge
        """
        out = np.zeros((len(self.body_from_lab), len(self.leds.id)), dtype=bool)
        size_px = np.array([self.camera.width_px, self.camera.height_px])
        margin = np.broadcast_to(margin_px, len(self.leds.id))[:, None]
        for row, attitude in zip(out, self.body_from_lab, strict=True):
            xy_px = np.nan_to_num(
                project(attitude, self.leds.position_m, self.lever, self.camera), nan=-1e9
            )
            inside = ((xy_px >= margin) & (xy_px <= size_px - 1 - margin)).all(axis=1)
            near = np.flatnonzero(((xy_px > -apart_px) & (xy_px < size_px + apart_px)).all(axis=1))
            if len(near) > 1:
                distance_px, _ = cKDTree(xy_px[near]).query(xy_px[near], 2)
                inside[near[distance_px[:, 1] < apart_px]] = False
            row[:] = inside
        return out

    def rays(self, frame: Ints, xy_px: Floats) -> tuple[Floats, Floats]:
        """(M, 3) origins and unit directions in the lab of the rays to lights at pixels (M, 2) of these frames."""
        lab_from_body = self.body_from_lab[frame].inv()
        directions = lab_from_body.apply(
            self.lever.cam_from_body.inv().apply(self.camera.rays(xy_px))
        )
        return lab_from_body.apply(np.tile(self.lever.camera_body_m, (len(frame), 1))), directions


@dataclass(frozen=True, slots=True)
class StrayLight:
    """A light at rest in the lab where no LED is expected: its place, and the number of frames that show it."""

    position_m: Floats
    frames: int


def dark(shown: Mask, seen: Mask) -> Ints:
    """Rows of the LEDs that never shine: seen in none of the n frames that must show them.

    By the share p of the other LEDs' images that are detected, chance leaves one of N LEDs so in N (1 - p)^n surveys.

    Parameters
    ----------
    shown, seen
        (F, N) LEDs that each frame must show, and those identified in it
    """
    count = shown.sum(axis=0)
    ever = seen.any(axis=0)
    trials = shown[:, ever].sum()
    hits = (shown & seen).sum()
    missed = (trials - hits + 1) / (trials + 2)
    surveys = len(count) * missed**count
    return np.flatnonzero(~ever & (count >= MIN_FRAMES) & (surveys < FALSE_ALARMS))


def displaced(list_m: Floats, found_m: Floats, covariance_m2: Floats) -> tuple[Ints, float]:
    """Rows of measured LEDs that are too far from their place in the list, and the list's error about each axis, m.

    An LED at the distance d has the test value d' (s^2 I + C)^-1 d, a chi-square of three degrees of freedom, C its
    covariance. The list's error s is the one for which the median of all measured LEDs is that of the chi-square,
    2.366. An LED is displaced if its value exceeds the quantile at FALSE_ALARMS / N.

    Parameters
    ----------
    covariance_m2
        (N, 3, 3) of the places found; NaN for LEDs that are not measured
    """
    rows = np.flatnonzero(np.isfinite(covariance_m2).all(axis=(1, 2)))
    if not len(rows):
        return rows, 0.0
    eigenvalue, axes = np.linalg.eigh(covariance_m2[rows])
    squared_m2 = np.einsum("nji,nj->ni", axes, (found_m - list_m)[rows]) ** 2

    def value(sigma_m: float) -> Floats:
        return np.asarray(
            np.sum(squared_m2 / (np.maximum(eigenvalue, 0) + sigma_m**2 + TINY_M2), axis=1)
        )

    low = 0.0
    high = float(np.sqrt(squared_m2.max()))
    for _ in range(60):  # bisection: the median falls with s
        middle = (low + high) / 2
        low, high = (middle, high) if np.median(value(middle)) > CHI2_MEDIAN else (low, middle)
    return rows[value(high) > _limit(len(rows))], high


def _limit(count: int) -> float:
    """Chi-square of three degrees of freedom that one of `count` LEDs exceeds in FALSE_ALARMS surveys."""
    return float(2 * gammainccinv(1.5, FALSE_ALARMS / count))


def stray_lights(
    held: HeldFrames, frame: Ints, xy_px: Floats, sigma_px: float, reach_m: float
) -> list[StrayLight]:
    """Lights at rest among those that are no known LED: (M,) frames and (M, 2) pixels.

    Each ray meets the assumed surface; points within `reach_m` of one another form a group. Its light is where the
    rays of at least MIN_FRAMES frames meet, each within GATE standard deviations; other rays, of reflections and faults
    of the chip, which are not at rest in the lab, are left out.

    Parameters
    ----------
    sigma_px
        Of a centroid
    reach_m
        Distance on the assumed surface within which lights may be the same
    """
    if len(frame) < MIN_FRAMES:
        return []
    origins, directions = held.rays(frame, xy_px)
    points = np.array(
        [on_surface(u[None], o, held.leds)[0] for o, u in zip(origins, directions, strict=True)]
    )
    points = np.nan_to_num(points, nan=1e9)
    pairs = cKDTree(points).query_pairs(reach_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    groups, label = connected_components(links, directed=False)
    sigma_rad = sigma_px / held.camera.focal_px
    out = []
    for group in range(groups):
        rows = np.flatnonzero(label == group)
        place_m = _meeting_point(origins[rows], directions[rows], points[rows], sigma_rad)
        if place_m is not None:
            near = _off_rad(place_m, origins[rows], directions[rows]) < GATE * sigma_rad
            count = len(np.unique(frame[rows[near]]))
            if count >= MIN_FRAMES:
                out.append(StrayLight(place_m, count))
    return out


def _meeting_point(
    origins: Floats, directions: Floats, points: Floats, sigma_rad: float
) -> Floats | None:
    """The place nearest to most of the rays; None if too few meet.

    Least squares of the distances from the rays, |(I - u u') (x - o)|^2, held to the surface by its own error. The rays
    that are used are first those within GATE of the best single point of the surface, then those within GATE of x.
    """
    if len(points) < MIN_FRAMES:
        return None
    distance_m = np.linalg.norm(points - origins, axis=1)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    at = np.median(points, axis=0)
    weak = (sigma_rad * distance_m.mean() / SURFACE_SIGMA_M) ** 2
    limit_rad = np.inf
    for _ in range(10):
        off_rad = _off_rad(at, origins, directions)
        near = off_rad <= max(limit_rad, GATE * sigma_rad)
        if near.sum() < MIN_FRAMES:
            return None
        matrix = across[near].sum(axis=0) + weak * np.eye(3)
        at = np.linalg.solve(
            matrix, np.einsum("nij,nj->i", across[near], origins[near]) + weak * at
        )
        limit_rad = 3 * float(np.median(_off_rad(at, origins, directions)[near]))
    return at


def _off_rad(place_m: Floats, origins: Floats, directions: Floats) -> Floats:
    """(N,) angles between rays and the direction to a place."""
    toward = place_m - origins
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(np.cross(toward, directions), axis=1))


def name_strays(
    strays: list[StrayLight], candidates: Ints, list_m: Floats, limit_m: float
) -> list[tuple[int, int]]:
    """Pairs (LED, stray) of LEDs that are not where the list has them, by the least sum of distances up to a limit."""
    if not strays or not len(candidates):
        return []
    places_m = np.array([stray.position_m for stray in strays])
    distance_m = np.linalg.norm(list_m[candidates][:, None] - places_m, axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distance_m, limit_m) ** 2)
    inside = distance_m[rows, columns] < limit_m
    return list(zip(candidates[rows[inside]].tolist(), columns[inside].tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class LightTable:
    """What the frames of a survey show of its LEDs.

    Attributes
    ----------
    light
        (F, N) light of each LED at unit distance, NaN if it is not identified in the frame
    shown
        (F, N) LEDs that the frame must show if they are on
    expected
        (F, N) light that each LED is expected to give, relative, 0 if its code has it off in
        the frame
    """

    light: Floats
    shown: Mask
    expected: Floats


@dataclass(frozen=True, slots=True)
class Exchange:
    """At the place of LED `led` shines the LED `shows` (rows); the others that would do as well are `or_any_of`."""

    led: int
    shows: int
    or_any_of: tuple[int, ...] = ()


def exchanged(table: LightTable) -> tuple[list[Exchange], float | None]:
    """LEDs whose light is another LED's, and the share of pairs of LEDs of which an exchange would be found; None if
    fewer than two LEDs are in enough frames to be compared.

    The log likelihood of LED j at the place of i is that of the logarithms of the light in the frames less the expected
    ones: of their mean, with the robust scatter of all LEDs between them, and of their deviations from it, with that
    from frame to frame; and of the frames in which it is on but not seen, or seen but off, with CHANCE each. Of the
    LEDs for which another one is more likely by half of the threshold
    T = ln(N^2 / 2 / FALSE_ALARMS), the most likely permutation is reported (linear assignment), if it gains T a pair.
    LEDs that are alike in all frames have equal likelihoods: their exchange has no effect on any frame.
    """
    likelihood = _log_likelihood(table)
    count = len(likelihood)
    own = np.diag(likelihood)
    least = np.log(max(count, 2) ** 2 / 2 / FALSE_ALARMS) / 2
    suspects = np.flatnonzero(likelihood.max(axis=1, initial=-np.inf) - own > least)
    tested = np.isfinite(table.light).sum(axis=0) >= MIN_FRAMES
    observable = _observable(table, likelihood, tested, least)
    if len(suspects) < 2:
        return [], observable
    among = likelihood[np.ix_(suspects, suspects)]
    rows, columns = linear_sum_assignment(-among)
    out = []
    for row, column in zip(rows, columns, strict=True):
        if row != column and among[row, column] - among[row, row] > least:
            alike = np.flatnonzero(among[row] > among[row, column] - least)
            others = tuple(int(suspects[k]) for k in alike if k not in (row, column))
            out.append(Exchange(int(suspects[row]), int(suspects[column]), others))
    return out, observable


def names(
    table: LightTable, list_m: Floats, found_m: Floats, covariance_m2: Floats
) -> tuple[Ints, Ints]:
    """The measured LEDs (rows), and the names (rows of the list) that their places and their light have together.

    A light is named by its place, and where two LEDs stand closer than a few errors of the list, the list may have them
    in the wrong order: each is then found at the other's place. The name j of the light at place x_i costs
    d' (s^2 I + C_i)^-1 d / 2 - ln L_ij, with d = x_i - list_j, s and C_i as in `displaced`, and L_ij the likelihood of
    its light (`exchanged`). The names are the assignment of the least sum (maximum a posteriori: Fortmann, Bar-Shalom &
    Scheffe 1983, IEEE J. Oceanic Eng. 8, 173). A name other than the present one is allowed only where the list could
    err so much: below the quantile of `displaced`. Exchanged wires of LEDs farther apart therefore keep the names of
    their places, and `exchanged` finds them; those of closer ones get the names of their light.
    """
    rows = np.flatnonzero(np.isfinite(covariance_m2).all(axis=(1, 2)))
    if not len(rows):
        return rows, rows
    _, sigma_m = displaced(list_m, found_m, covariance_m2)
    limit = _limit(len(rows))
    information = np.linalg.inv(covariance_m2[rows] + (sigma_m**2 + TINY_M2) * np.eye(3))
    reach_m = np.sqrt(limit / np.linalg.eigvalsh(information)[:, 0])
    near = cKDTree(list_m).query_ball_point(found_m[rows], reach_m)
    at = np.repeat(np.arange(len(rows)), [len(one) for one in near])
    name = np.concatenate([np.asarray(one, dtype=np.int64) for one in near])
    off_m = found_m[rows[at]] - list_m[name]
    squares = np.einsum("ni,nij,nj->n", off_m, information[at], off_m)
    likelihood = _log_likelihood(table)
    cost = np.full((len(rows), len(list_m)), FORBIDDEN)
    cost[np.arange(len(rows)), rows] = np.minimum(
        limit / 2 - likelihood[rows, rows], FORBIDDEN / 10
    )
    inside = squares < limit
    at = at[inside]
    name = name[inside]
    cost[at, name] = squares[inside] / 2 - likelihood[rows[at], name]
    return rows, np.asarray(linear_sum_assignment(cost)[1])


def _log_likelihood(table: LightTable) -> Floats:
    """(N, N) log likelihood that the light at the place of LED i (rows) is that of LED j (columns)."""
    seen = np.isfinite(table.light)
    on = table.expected > 0
    log_light = np.log(np.where(seen, table.light, 1.0))
    log_expected = np.log(np.where(on, table.expected, 1.0))
    both = seen & on
    # The zero of each frame, by the LEDs in it, removes exposure and gain.
    own = np.where(both, log_light - log_expected, np.nan)
    zero = np.array([np.nanmedian(row) if np.isfinite(row).any() else 0.0 for row in own])
    centered = np.where(seen, log_light - zero[:, None], 0.0)
    indicator = seen.T.astype(float)
    level = np.where(on, log_expected, 0.0)
    counts = np.maximum(indicator @ on, 1)  # (N, N) frames in which i is seen and j on
    mean = (centered.T @ on - indicator @ level) / counts
    squares = (centered**2).T @ on - 2 * centered.T @ level + indicator @ level**2
    within = np.maximum(squares - counts * mean**2, 0)
    tested = both.sum(axis=0) >= MIN_FRAMES
    between_sigma = within_sigma = MIN_SCATTER
    if tested.any():
        between_sigma = max(
            SIGMA_PER_MAD * float(np.median(np.abs(np.diag(mean)[tested]))), MIN_SCATTER
        )
        spread = np.sqrt(np.diag(within) / np.maximum(np.diag(counts) - 1, 1))
        within_sigma = max(float(np.median(spread[tested])), MIN_SCATTER)
    silent = table.shown & ~seen
    wrong = indicator @ ~on + silent.T.astype(float) @ on
    out = -((mean / between_sigma) ** 2 + within / within_sigma**2) / 2 + wrong * np.log(CHANCE)
    out[~tested] = 0.0
    return np.asarray(out)


def _observable(table: LightTable, likelihood: Floats, tested: Mask, least: float) -> float | None:
    """Share of the pairs of tested LEDs whose exchange would be found, by the likelihoods as they are."""
    rows = np.flatnonzero(tested)
    if len(rows) < 2:
        return None
    worse = np.diag(likelihood)[rows, None] - likelihood[np.ix_(rows, rows)] > least
    return float(np.sum(worse & worse.T) / (len(rows) * (len(rows) - 1)))
