"""The lab's own calibration, as AFIT did it: a catalogue seen from the home position, and how well it repeats.

Padro 2012, sections 3.6.3 and 3.6.4: the vehicle is held at several positions; in every frame the lights are carried
from the camera to the bearing (his eqs 43-44) and from there into the lab by the IMU's angles. How closely the same
light comes back to the same place gives epsilon_position; the angles between lights (eq. 45) need no IMU and give
epsilon_separation; the brightness gives epsilon_magnitude.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, on_surface
from estimator.attitude.nearfield import thesis_points
from estimator.catalog.catalog import unit
from estimator.core.arrays import Floats, Ints
from estimator.core.camera import Camera
from estimator.core.errors import ImageError


@dataclass(frozen=True, slots=True)
class Sighting:
    """One frame whose lights have names.

    position      : at which of the vehicle's stops it was taken; that of the first sighting is home
    body_from_lab : the attitude by the IMU. It was zeroed at home: the body's axes there are the lab's
    led           : (K,) ids, each once;  xy_px : (K, 2) centroids;  magnitude : (K,) see `instrument_magnitude`
    """

    position: int
    body_from_lab: Rotation
    led: Ints
    xy_px: Floats
    magnitude: Floats


@dataclass(frozen=True, slots=True)
class HomeCatalogue:
    """Where the lights stand about the bearing, seen from home, brightest first (section 3.6.4), in the lab frame.

    id, magnitude  : (N,) a magnitude grows with the light
    vectors        : (N, 3) unit, from the bearing
    position_m     : (N, 3) where eqs 43-44 put the light: near the dome, not on it
    covariance_m2  : (N, 3, 3) of one frame's position about its mean, over all frames; NaN where there is one
    samples        : (N,) frames that the place and the magnitude are the mean of
    epsilon_mag, epsilon_pos_m, epsilon_sep_rad : one standard deviation of a magnitude, of a coordinate of a place
        and of the angle between two lights: the greatest of all lights, coordinates and pairs
    """

    id: Ints
    vectors: Floats
    magnitude: Floats
    position_m: Floats
    covariance_m2: Floats
    samples: Ints
    epsilon_mag: float
    epsilon_pos_m: float
    epsilon_sep_rad: float

    def __len__(self) -> int:
        return len(self.id)

    @property
    def epsilon_pos_rad(self) -> float:
        """epsilon_pos_m as an angle about the bearing, at the mean distance of the lights."""
        return self.epsilon_pos_m / float(np.linalg.norm(self.position_m, axis=1).mean())


def instrument_magnitude(mean_dn: Floats, area_px: Floats) -> Floats:
    """(N,) light of each blob of a frame by the frame's median blob: mean brightness times area over median area.

    Section 3.6.2.1 says only that the mean brightness is "normalised against the median LED area"; his dim means of
    7 lie below his own threshold of 10.2, so that the area must come in (reference 1.2, item 13: inferred). What all
    blobs share, such as a defocus that spreads them alike, changes it as it changes mean brightness.
    """
    return mean_dn * area_px / np.median(area_px)


def pooled(value: Floats, group: Ints, position: Ints) -> Floats:
    """(G,) standard deviation, n - 1, of each group's values over all frames: what differs between stops counts.

    Section 3.6.3: "across the total number of recorded observations". One value gives NaN.
    """
    count = np.bincount(group)
    off_mean = value - (np.bincount(group, value) / np.maximum(count, 1))[group]
    squares = np.bincount(group, off_mean**2)
    return np.where(count > 1, np.sqrt(squares / np.maximum(count - 1, 1)), np.nan)


def averaged(value: Floats, group: Ints, position: Ints) -> Floats:
    """(G,) mean over the stops of the standard deviation at each: what differs between stops, as an error of the IMU's
    angles does, leaves no trace.

    Section 4.4.1: "the averaged multi-positional standard deviation values". NaN where no stop has two frames.
    """
    _, stop = np.unique(position, return_inverse=True)
    stops = stop.max() + 1
    at_stop = np.full((group.max() + 1) * stops, np.nan)
    spread = pooled(value, group * stops + stop, position)
    at_stop[: len(spread)] = spread
    table = at_stop.reshape(-1, stops)
    known = np.isfinite(table)
    some = known.any(axis=1)
    total = np.where(known, table, 0.0).sum(axis=1)
    return np.where(some, total / np.maximum(known.sum(axis=1), 1), np.nan)


# The thesis says both; Table 4 has a pooled figure under "Avg", and Table 9 a position's that is too small for one if
# the IMU's angles were those of Tables 10-14 (reference 1.2, items 3 and 15).
Spread = Callable[[Floats, Ints, Ints], Floats]
SPREADS: dict[str, Spread] = {"pooled": pooled, "averaged": averaged}


class _Samples(NamedTuple):
    """Every light of every frame: rows of the ids, the frame, its stop, places in body and lab axes, magnitudes."""

    led: Ints
    frame: Ints
    position: Ints
    body_m: Floats
    lab_m: Floats
    magnitude: Floats


def calibrate(
    sightings: Sequence[Sighting],
    camera: Camera,
    surface: LedMap,
    lever: Lever,
    sine: bool = False,
    spread: str = "pooled",
    home_only: bool = True,
) -> HomeCatalogue:
    """The catalogue and its epsilons by AFIT's procedure (Padro 2012, sections 3.6.3-3.6.4 and 4.4.1).

    surface   : the believed dome, of which R is taken; its LEDs are not used
    sine      : whether the slip of tan for sin in eq. 44 is put right (reference 1.2, item 11)
    spread    : a name in SPREADS: which standard deviation an epsilon is the greatest of
    home_only : the catalogue from the frames at home, as he did, with every epsilon from all frames; else the mean
        over all frames (the black marks of his Fig. 79), in which an IMU's error at a stop stays
    Raises ImageError for sightings that disagree with themselves or leave a spread unknown.
    """
    id_, samples = _placed(sightings, camera, surface, lever, sine)
    deviation = SPREADS[spread]
    coordinates = [deviation(column, samples.led, samples.position) for column in samples.lab_m.T]
    angle, pair, stop = _separations(samples)
    epsilons = (
        _greatest(deviation(samples.magnitude, samples.led, samples.position), "light"),
        _greatest(np.concatenate(coordinates), "light"),
        _greatest(deviation(angle, pair, stop), "pair of lights"),
    )
    used = samples.position == sightings[0].position if home_only else np.ones(len(samples.led), bool)
    order, place_m, magnitude, count = _brightest_first(samples, used)
    covariance = _covariance(samples.lab_m, samples.led)[order]
    return HomeCatalogue(id_[order], unit(place_m), magnitude, place_m, covariance, count, *epsilons)


def _brightest_first(samples: _Samples, used: NDArray[np.bool_]) -> tuple[Ints, Floats, Floats, Ints]:
    """Rows of the lights seen in the frames used, their mean places (N, 3), mean magnitudes, and how many frames."""
    led = samples.led[used]
    count = np.bincount(led)
    total = [np.bincount(led, column) for column in (*samples.lab_m[used].T, samples.magnitude[used])]
    mean = np.column_stack(total) / np.maximum(count, 1)[:, None]
    order = np.argsort(-mean[:, 3], kind="stable")
    order = order[count[order] > 0]
    return order, mean[order, :3], mean[order, 3], count[order]


def _placed(
    sightings: Sequence[Sighting], camera: Camera, surface: LedMap, lever: Lever, sine: bool
) -> tuple[Ints, _Samples]:
    """The ids seen, and each light of each frame brought to the home attitude by the IMU's angles."""
    if not len(sightings):
        raise ImageError("no sightings: a calibration needs at least two frames")
    for number, seen in enumerate(sightings):
        _check(number, seen)
    body_m, lab_m = [], []
    for seen in sightings:
        point_cam, _ = thesis_points(camera.rays(seen.xy_px), surface, lever, sine)
        point_body = lever.cam_from_body.inv().apply(point_cam) + lever.camera_body_m
        body_m.append(point_body)
        lab_m.append(seen.body_from_lab.inv().apply(point_body))
    lights = [len(seen.led) for seen in sightings]
    id_, led = np.unique(np.concatenate([seen.led for seen in sightings]), return_inverse=True)
    frame = np.repeat(np.arange(len(sightings)), lights)
    position = np.repeat([seen.position for seen in sightings], lights)
    magnitude = np.concatenate([seen.magnitude for seen in sightings])
    return id_, _Samples(led, frame, position, np.vstack(body_m), np.vstack(lab_m), magnitude)


def _check(number: int, seen: Sighting) -> None:
    lights = len(seen.led)
    if not lights or seen.xy_px.shape != (lights, 2) or seen.magnitude.shape != (lights,):
        raise ImageError(
            f"sighting {number}: {lights} names, centroids {seen.xy_px.shape}, magnitudes "
            f"{seen.magnitude.shape}; allowed: K names, (K, 2) and (K,), K from 1"
        )
    if len(np.unique(seen.led)) < lights:
        raise ImageError(f"sighting {number}: a light has two centroids; each id may stand once")
    if not (np.isfinite(seen.xy_px).all() and np.isfinite(seen.magnitude).all()):
        raise ImageError(f"sighting {number}: a centroid or a magnitude is not finite")


def _separations(samples: _Samples) -> tuple[Floats, Ints, Ints]:
    """The angle about the bearing of every pair in every frame (eq. 45), rad; which pair it is; the frame's stop.

    By the half-chord, which keeps the digits of small angles that the arc cosine of eq. 45 loses.
    """
    direction = unit(samples.body_m)
    first, second = [], []
    for rows in np.split(np.arange(len(samples.led)), np.flatnonzero(np.diff(samples.frame)) + 1):
        i, j = np.triu_indices(len(rows), 1)
        first.append(rows[i])
        second.append(rows[j])
    a, b = np.concatenate(first), np.concatenate(second)
    if not len(a):
        raise ImageError("no frame shows two lights: no angle between lights to take a spread of")
    angle = 2 * np.arcsin(np.linalg.norm(direction[a] - direction[b], axis=1) / 2)
    low, high = np.sort([samples.led[a], samples.led[b]], axis=0)
    _, pair = np.unique(low * (samples.led.max() + 1) + high, return_inverse=True)
    return angle, pair, samples.position[a]


def _greatest(spread: Floats, of: str) -> float:
    known = spread[np.isfinite(spread)]
    if not len(known):
        raise ImageError(f"each {of} has one sample: its spread is unknown; two frames of it are needed")
    return float(known.max())


def _covariance(lab_m: Floats, led: Ints) -> Floats:
    """(N, 3, 3) sample covariance of each light's places, m^2."""
    count = np.bincount(led)
    mean_m = np.array([np.bincount(led, column) for column in lab_m.T]) / count
    off_mean = lab_m - mean_m.T[led]
    covariance = np.zeros((len(count), 3, 3))
    np.add.at(covariance, led, np.einsum("si,sj->sij", off_mean, off_mean))
    covariance[count < 2] = np.nan
    return covariance / np.maximum(count - 1, 1)[:, None, None]


def led_map(catalogue: HomeCatalogue, surface: LedMap) -> LedMap:
    """The catalogue's lights on a believed surface: where their directions from the bearing meet it, for a tracker.

    surface : whose ellipsoid is believed; its own LEDs are not used. Raises ImageError where a direction misses it.
    """
    position_m = on_surface(catalogue.vectors, np.zeros(3), surface)
    missed = catalogue.id[np.isnan(position_m).any(axis=1)]
    if len(missed):
        raise ImageError(f"LED {missed[0]}: its direction from the bearing misses the believed surface")
    return LedMap(catalogue.id, position_m, surface.centre_m, surface.semi_axes_m)
