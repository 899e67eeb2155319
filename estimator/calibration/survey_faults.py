"""Faults of a dome found by its survey: LEDs that are dark, far from their place in the list, or exchanged.

1. `names` gives each light the name that its place and brightness together determine, so that errors of the list are
   no faults.
2. `dark` finds LEDs that never shine, `displaced` LEDs far from their place in the list.
3. `stray_lights` finds lights at rest where no LED is expected, and `name_strays` assigns them to missing LEDs.
4. `exchanged` finds LEDs that shine with another LED's light.

A fault is reported only if chance would make it in fewer than FALSE_ALARMS surveys of a dome without one, all LEDs
together (Bonferroni: each of N LEDs is tested at FALSE_ALARMS / N).
"""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import gammainccinv

from estimator.attitude.dome_map import LedMap, Lever, on_surface, project
from estimator.catalog.catalog import close_groups
from estimator.core.camera import Camera
from estimator.core.checks import Bools, Floats, Ints, frozen
from estimator.core.constants import SIGMA_PER_MAD
from estimator.core.vectors import lengths, normalized

FALSE_ALARMS = 1e-3  # share of surveys with a false alarm of one kind
MIN_FRAMES = 3  # least number of frames that show a light, or fail to show it
CHI2_MEDIAN = 2.366  # median of a chi-square of three degrees of freedom
TINY_M2 = 1e-18  # added to variances, which could be 0
# Standard deviation of the assumed surface, which determines the distance of a light seen from one side only.
SURFACE_SIGMA_M = 0.005
GATE = 5.0  # largest distance of a ray from its light, in standard deviations
MIN_SCATTER = 0.02  # least standard deviation of the logarithm of an LED's light
# Probability that a light is missed although it is on, or seen although it is off
CHANCE = 0.02
FORBIDDEN = 1e7  # cost of a name that is not allowed


@frozen
class HeldFrames:
    """Attitudes of a survey's F frames, and the model that it found."""

    camera: Camera
    leds: LedMap
    lever: Lever
    body_from_lab: Rotation

    def shown(self, margin_px: float | Floats, apart_px: float) -> Bools:
        """Return (F, N) whether a frame must show an LED if that shines.

        It must if the LED is inside the frame by a margin, and far enough from all other LEDs.

        Parameters
        ----------
        margin_px
            Least distance from the frame's edge: one number, or (N,)
        apart_px
            Least distance from other LEDs, whose images may merge with it
        """
        rows = []
        size_px = np.array([self.camera.width_px, self.camera.height_px])
        margin = np.broadcast_to(margin_px, len(self.leds.id))[:, None]
        for attitude in self.body_from_lab:
            # NaN for an LED behind the camera, which is outside everything.
            xy_px = project(attitude, self.leds.position_m, self.lever, self.camera)
            inside = ((xy_px >= margin) & (xy_px <= size_px - 1 - margin)).all(axis=1)
            # Distance to the nearest other LED, one outside the frame included
            around = (xy_px > -apart_px) & (xy_px < size_px + apart_px)
            near = np.flatnonzero(around.all(axis=1))
            if len(near) > 1:
                distance_px, _ = cKDTree(xy_px[near]).query(xy_px[near], 2)
                inside[near[distance_px[:, 1] < apart_px]] = False
            rows.append(inside)
        return np.array(rows)

    def rays(self, frame: Ints, xy_px: Floats) -> tuple[Floats, Floats]:
        """Return the (M, 3) origins and unit directions, in the lab, of the rays to pixels (M, 2) of frames (M,)."""
        lab_from_body = self.body_from_lab[frame].inv()
        rays_body = self.lever.body_from_cam.apply(self.camera.rays(xy_px))
        origins = lab_from_body.apply(np.tile(self.lever.camera_body_m, (len(frame), 1)))
        return origins, lab_from_body.apply(rays_body)


def dark(shown: Bools, seen: Bools) -> Ints:
    """Return the rows of the LEDs that never shine: seen in none of the n frames that must show them.

    With the share p of the other LEDs' images that are detected, chance leaves one of N LEDs unseen in N (1 - p)^n
    surveys. The share is estimated with one more detection and one more miss (Laplace's rule).

    Parameters
    ----------
    shown, seen
        (F, N) whether each frame must show each LED, and whether the LED is identified in it
    """
    count = shown.sum(axis=0)
    ever = seen.any(axis=0)
    trials = shown[:, ever].sum()
    hits = (shown & seen).sum()
    missed = (trials - hits + 1) / (trials + 2)  # 1 - p
    surveys = len(count) * missed**count
    return np.flatnonzero(~ever & (count >= MIN_FRAMES) & (surveys < FALSE_ALARMS))


def displaced(list_m: Floats, found_m: Floats, covariance_m2: Floats) -> tuple[Ints, float]:
    """Return the rows of measured LEDs that are too far from their place in the list, and the list's error s, m.

    An LED at the distance d from its place, with the covariance C, has the test value d^T (s^2 I + C)^-1 d, a
    chi-square of three degrees of freedom.

    1. Diagonalize the covariances: the test value is then a sum over the axes.
    2. Find the list's error s along each axis, by bisection: the median of all values is that of the chi-square, 2.366.
    3. An LED is displaced if its value exceeds the quantile at FALSE_ALARMS / N.

    Parameters
    ----------
    list_m, found_m
        (N, 3) positions in the list, and as found by the survey
    covariance_m2
        (N, 3, 3) covariance of the positions found; NaN for LEDs that are not measured
    """
    # 1. Squared distances along the axes of each covariance
    rows = _measured(covariance_m2)
    if not len(rows):
        return rows, 0.0
    eigenvalue, axes = np.linalg.eigh(covariance_m2[rows])
    squared_m2 = np.einsum("nji,nj->ni", axes, (found_m - list_m)[rows]) ** 2

    def value(sigma_m: float) -> Floats:
        variance_m2 = np.maximum(eigenvalue, 0) + sigma_m**2 + TINY_M2
        return np.sum(squared_m2 / variance_m2, axis=1)

    # 2. Bisection: the median falls with s.
    low = 0.0
    high = float(np.sqrt(squared_m2.max()))
    for _ in range(60):
        middle = (low + high) / 2
        if np.median(value(middle)) > CHI2_MEDIAN:
            low = middle
        else:
            high = middle
    # 3. Displaced LEDs
    return rows[value(high) > _limit(len(rows))], high


def found_displacements_m(covariance_m2: Floats, sigma_m: float) -> Floats:
    """Return the displacement of each measured LED that `displaced` finds in 95 % of surveys, in any direction, m.

    Along the axis of the greatest variance v the root of the test value errs by 1: (sqrt(limit) + 1.645) sqrt(s^2 + v).

    Parameters
    ----------
    covariance_m2, sigma_m
        As of `displaced`: covariances, NaN for LEDs that are not measured, and the list's error s
    """
    measured = covariance_m2[_measured(covariance_m2)]
    greatest_m2 = np.linalg.eigvalsh(measured)[:, 2] + sigma_m**2
    return (np.sqrt(_limit(len(measured))) + 1.645) * np.sqrt(greatest_m2)


def _measured(covariance_m2: Floats) -> Ints:
    """Return the rows of the lights with a covariance."""
    return np.flatnonzero(np.isfinite(covariance_m2).all(axis=(1, 2)))


def _limit(count: int) -> float:
    """Return the chi-square of three degrees of freedom that one of `count` LEDs exceeds in FALSE_ALARMS surveys."""
    return float(2 * gammainccinv(1.5, FALSE_ALARMS / count))


def stray_lights(
    held: HeldFrames, frame: Ints, xy_px: Floats, sigma_px: float, reach_m: float
) -> list[Floats]:
    """Return the (3,) positions in the lab of the lights at rest among those that are no known LED.

    1. Intersect each ray with the assumed surface.
    2. Group the points that are within `reach_m` of one another.
    3. Find the point where the rays of a group meet (`_meeting_point`).
    4. Keep it if the rays of at least MIN_FRAMES frames pass it within GATE standard deviations. Reflections and faults
       of the chip are not at rest in the lab, so their rays do not meet.

    Parameters
    ----------
    frame, xy_px
        (M,) frame and (M, 2) pixel of each light that is no known LED
    sigma_px
        Standard deviation of a centroid
    reach_m
        Distance on the assumed surface within which lights may be the same
    """
    if len(frame) < MIN_FRAMES:
        return []
    # 1. Points on the surface; a ray that misses it is put far away.
    origins, directions = held.rays(frame, xy_px)
    points = np.array(
        [
            on_surface(u[None], o, held.leds)[0]
            for o, u in zip(origins, directions, strict=True)
        ]
    )
    points = np.nan_to_num(points, nan=1e9)
    # 2. Groups
    label = close_groups(points, reach_m)
    sigma_rad = sigma_px / held.camera.focal_px
    out = []
    for group in range(label.max() + 1):
        # 3. Meeting point
        rows = np.flatnonzero(label == group)
        place_m = _meeting_point(origins[rows], directions[rows], points[rows], sigma_rad)
        if place_m is None:
            continue
        # 4. Number of frames
        near = _off_rad(place_m, origins[rows], directions[rows]) < GATE * sigma_rad
        if len(np.unique(frame[rows[near]])) >= MIN_FRAMES:
            out.append(place_m)
    return out


def _meeting_point(
    origins: Floats, directions: Floats, points: Floats, sigma_rad: float
) -> Floats | None:
    """Return the point x nearest to most of the rays; None if too few meet.

    x minimizes the sum of the squared distances from the rays with origins o and directions u,
    |(I - u u^T) (x - o)|^2, plus a weak term that holds it near its last value, by the surface's own error. It starts
    from the median of the points on the surface, with all rays; each round:

    1. Select the rays within three times the median angle of the last round from x, or within GATE if that is larger.
    2. Solve for x.
    """
    distance_m = lengths(points - origins)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    at = np.median(points, axis=0)
    weak = (sigma_rad * distance_m.mean() / SURFACE_SIGMA_M) ** 2
    limit_rad = np.inf
    for _ in range(10):
        # 1. Rays
        off_rad = _off_rad(at, origins, directions)
        near = off_rad <= max(limit_rad, GATE * sigma_rad)
        if near.sum() < MIN_FRAMES:
            return None
        # 2. Least squares
        matrix = across[near].sum(axis=0) + weak * np.eye(3)
        right = np.einsum("nij,nj->i", across[near], origins[near]) + weak * at
        at = np.linalg.solve(matrix, right)
        limit_rad = 3 * float(np.median(_off_rad(at, origins, directions)[near]))
    return at


def _off_rad(place_m: Floats, origins: Floats, directions: Floats) -> Floats:
    """Return the (N,) sines of the angles between rays and the directions from their origins to a place."""
    toward = normalized(place_m - origins)
    return lengths(np.cross(toward, directions))


def name_strays(
    strays: list[Floats], candidates: Ints, list_m: Floats, limit_m: float
) -> list[tuple[int, int]]:
    """Return pairs (LED, stray) of LEDs that are not at their place in the list, and the lights that they may be.

    The pairs minimize the sum of squared distances, each counted up to the limit.

    Parameters
    ----------
    candidates
        Rows of the LEDs that are missing
    list_m
        (N, 3) positions in the list
    limit_m
        Largest distance of a pair
    """
    if not strays or not len(candidates):
        return []
    distance_m = lengths(list_m[candidates][:, None] - np.array(strays))
    rows, columns = linear_sum_assignment(np.minimum(distance_m, limit_m) ** 2)
    inside = distance_m[rows, columns] < limit_m
    leds = candidates[rows[inside]].tolist()
    return list(zip(leds, columns[inside].tolist(), strict=True))


@frozen
class LightTable:
    """Light of a survey's LEDs in its frames.

    Attributes
    ----------
    light
        (F, N) light of each LED at unit distance, NaN if it is not identified in the frame
    shown
        (F, N) whether the frame must show the LED if that is on
    expected
        (F, N) relative light that each LED is expected to give, 0 if its code has it off in the
        frame
    """

    light: Floats
    shown: Bools
    expected: Floats


@frozen
class Exchange:
    """An LED that shines at the place of another one.

    Attributes
    ----------
    led
        Row of the LED whose place it is
    shows
        Row of the LED that shines there
    or_any_of
        Rows of other LEDs that explain the light as well
    """

    led: int
    shows: int
    or_any_of: tuple[int, ...] = ()


def exchanged(table: LightTable) -> tuple[list[Exchange], float | None]:
    """Return the LEDs that shine with another LED's light, and the share of pairs whose exchange would be found.

    The share is None if fewer than two LEDs are in enough frames to be compared.

    1. Compute the log likelihood of each LED's light at each place (`_log_likelihood`).
    2. Suspect the LEDs for which another one is more likely by half of the threshold T = ln(N^2 / 2 / FALSE_ALARMS).
    3. Find the most likely permutation of the suspects (linear assignment).
    4. Report those that gain T / 2 each, T a pair.

    LEDs that are alike in all frames have equal likelihoods: their exchange has no effect on any frame.
    """
    # 1. Likelihoods
    likelihood = _log_likelihood(table)
    count = len(likelihood)
    own = np.diag(likelihood)
    # 2. Suspects
    least = np.log(max(count, 2) ** 2 / 2 / FALSE_ALARMS) / 2
    suspects = np.flatnonzero(likelihood.max(axis=1, initial=-np.inf) - own > least)
    # An exchange would be found if each of the two LEDs explains the other's light worse.
    tested = np.flatnonzero(np.isfinite(table.light).sum(axis=0) >= MIN_FRAMES)
    worse = own[tested, None] - likelihood[np.ix_(tested, tested)] > least
    pairs = len(tested) * (len(tested) - 1)
    observable = float(np.sum(worse & worse.T) / pairs) if pairs else None
    if len(suspects) < 2:
        return [], observable
    # 3. Permutation
    among = likelihood[np.ix_(suspects, suspects)]
    rows, columns = linear_sum_assignment(-among)
    out = []
    for row, column in zip(rows, columns, strict=True):
        # 4. Report, with the suspects that explain the light as well
        if row != column and among[row, column] - among[row, row] > least:
            alike = np.flatnonzero(among[row] > among[row, column] - least)
            others = tuple(int(suspects[k]) for k in alike if k not in (row, column))
            out.append(Exchange(int(suspects[row]), int(suspects[column]), others))
    return out, observable


def names(
    table: LightTable, list_m: Floats, found_m: Floats, covariance_m2: Floats
) -> tuple[Ints, Ints]:
    """Return the rows of the measured LEDs, and the names (rows of the list) by their places and their light together.

    A survey names a light by its place. Where two LEDs are closer than a few errors of the list, the list may have them
    in the wrong order: each is then found at the other's place. The name j of the light at place x_i costs

        d^T (s^2 I + C_i)^-1 d / 2 - ln L_ij,

    with d = x_i - list_j, s and C_i as in `displaced`, and L_ij the likelihood of its light (`_log_likelihood`). The
    names are the assignment of the least sum (maximum a posteriori: Fortmann, Bar-Shalom & Scheffe 1983, IEEE J.
    Oceanic Eng. 8, 173).

    1. Estimate the list's error s.
    2. Find the names within reach of each light. A name other than the present one is allowed only where the list's
       error could explain it: below the quantile of `displaced`.
    3. Compute the costs, and solve the assignment.

    Exchanged wires of LEDs farther apart therefore keep the names of their places, and `exchanged` finds them; those of
    closer ones get the names of their light.

    Parameters
    ----------
    list_m, found_m, covariance_m2
        (N, 3), (N, 3) and (N, 3, 3) positions in the list, as found, and their covariance, as of
        `displaced`
    """
    rows = _measured(covariance_m2)
    if not len(rows):
        return rows, rows
    # 1. Error of the list
    _, sigma_m = displaced(list_m, found_m, covariance_m2)
    limit = _limit(len(rows))
    information = np.linalg.inv(covariance_m2[rows] + (sigma_m**2 + TINY_M2) * np.eye(3))
    # 2. Names within the longest axis of the limiting ellipsoid, then within the ellipsoid itself
    reach_m = np.sqrt(limit / np.linalg.eigvalsh(information)[:, 0])
    near = cKDTree(list_m).query_ball_point(found_m[rows], reach_m)
    at = np.repeat(np.arange(len(rows)), [len(one) for one in near])
    name = np.concatenate([np.asarray(one, dtype=np.int64) for one in near])
    off_m = found_m[rows[at]] - list_m[name]
    squares = np.einsum("ni,nij,nj->n", off_m, information[at], off_m)
    inside = squares < limit
    at = at[inside]
    name = name[inside]
    # 3. Costs. The present name is always allowed, at most at the limit's cost.
    likelihood = _log_likelihood(table)
    cost = np.full((len(rows), len(list_m)), FORBIDDEN)
    present = limit / 2 - likelihood[rows, rows]
    cost[np.arange(len(rows)), rows] = np.minimum(present, FORBIDDEN / 10)
    cost[at, name] = squares[inside] / 2 - likelihood[rows[at], name]
    return rows, np.asarray(linear_sum_assignment(cost)[1])


def _log_likelihood(table: LightTable) -> Floats:
    """Return the (N, N) log likelihood that the light at the place of LED i (rows) is that of LED j (columns).

    With x_f the logarithm of the ratio of measured to expected light in frame f, it is

        -[(mean x / s_between)^2 + sum (x_f - mean x)^2 / s_within^2] / 2 + n ln CHANCE.

    1. Remove each frame's zero, the median of x over its LEDs: exposure and gain.
    2. Compute mean and sum of squares of x for all pairs i, j, by matrix products.
    3. Estimate the scatters s_between, of the means between LEDs, and s_within, from frame to frame, robustly.
    4. Count the n frames in which the light is on but not seen, or seen but off.

    LEDs in too few frames have the log likelihood 0.
    """
    seen = np.isfinite(table.light)
    on = table.expected > 0
    log_light = np.log(np.where(seen, table.light, 1.0))
    log_expected = np.log(np.where(on, table.expected, 1.0))
    both = seen & on
    # 1. Zero of each frame
    own = np.where(both, log_light - log_expected, np.nan)
    zero = np.zeros(len(own))
    for frame in np.flatnonzero(np.isfinite(own).any(axis=1)):
        zero[frame] = np.nanmedian(own[frame])
    centered = np.where(seen, log_light - zero[:, None], 0.0)
    # 2. Mean and sum of squares
    indicator = seen.T.astype(float)
    level = np.where(on, log_expected, 0.0)
    counts = np.maximum(indicator @ on, 1)  # (N, N) frames in which i is seen and j on
    mean = (centered.T @ on - indicator @ level) / counts
    squares = (centered**2).T @ on - 2 * centered.T @ level + indicator @ level**2
    within = np.maximum(squares - counts * mean**2, 0)
    # 3. Scatters, of the LEDs at their own places
    tested = both.sum(axis=0) >= MIN_FRAMES
    between_sigma = within_sigma = MIN_SCATTER
    if tested.any():
        between = SIGMA_PER_MAD * float(np.median(np.abs(np.diag(mean)[tested])))
        between_sigma = max(between, MIN_SCATTER)
        spread = np.sqrt(np.diag(within) / np.maximum(np.diag(counts) - 1, 1))
        within_sigma = max(float(np.median(spread[tested])), MIN_SCATTER)
    # 4. Frames that contradict the LED's code
    silent = table.shown & ~seen
    wrong = indicator @ ~on + silent.T.astype(float) @ on
    chi2 = (mean / between_sigma) ** 2 + within / within_sigma**2
    out = wrong * np.log(CHANCE) - chi2 / 2
    out[~tested] = 0.0
    return out
