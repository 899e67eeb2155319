"""AFIT's laboratory calibration: an LED catalog measured from the home position, and its repeatability.

The source is Padro 2012, sections 3.6.3 and 3.6.4. The vehicle is held at several positions (stops), and `calibrate`
takes these steps:

1. In every frame, transform the directions of the lights from the camera to the bearing (his eqs 43-44), and from there
   to the lab frame with the IMU's angles.
2. Compute the repeatability: of a light's position, epsilon_position; of the angles between lights (eq. 45), which need
   no IMU, epsilon_separation; of the brightness, epsilon_magnitude.
3. Average positions and brightness for the catalog.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, on_surface
from estimator.attitude.nearfield import thesis_points
from estimator.calibration.bundle_adjustment import summed
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints, frozen
from estimator.core.errors import ImageError
from estimator.core.vectors import lengths, normalized


@frozen
class Sighting:
    """One frame with identified lights.

    Attributes
    ----------
    stop
        Number of the vehicle's stop; the stop of the first sighting is home
    body_from_lab
        Attitude from the IMU, which is zeroed at home: there the body axes are those of the lab
        frame
    led
        (K,) id of each light, each once
    xy_px
        (K, 2) centroids
    brightness
        (K,) brightness, as of `instrument_brightness`
    """

    stop: int
    body_from_lab: Rotation
    led: Ints
    xy_px: Floats
    brightness: Floats


@frozen
class HomeCatalog:
    """LED catalog about the bearing, in the lab frame, brightest first (section 3.6.4).

    Attributes
    ----------
    id, brightness
        (N,) id and mean brightness of each light
    vectors
        (N, 3) unit vectors from the bearing
    position_m
        (N, 3) positions by eqs 43-44: near the dome, not on it
    covariance_m2
        (N, 3, 3) covariance of one frame's position about its mean, over all frames; NaN for a
        single frame
    samples
        (N,) number of frames averaged for position and brightness
    epsilon_mag, epsilon_pos_m, epsilon_sep_rad
        Standard deviations of a brightness, of a coordinate of a position and of the angle
        between two lights: the largest over all lights, coordinates and pairs
    """

    id: Ints
    vectors: Floats
    brightness: Floats
    position_m: Floats
    covariance_m2: Floats
    samples: Ints
    epsilon_mag: float
    epsilon_pos_m: float
    epsilon_sep_rad: float

    def __len__(self) -> int:
        return len(self.id)


def instrument_brightness(mean_dn: Floats, area_px: Floats) -> Floats:
    """Return the (N,) brightness of a frame's blobs: mean value times area over the frame's median area.

    Section 3.6.2.1 says only that the mean brightness is "normalized against the median LED area"; the thesis's dim
    means of 7 are below its own threshold of 10.2, so the area must be a factor (reference 1.2, item 13: inferred). A
    change common to all blobs, such as defocus, changes the result in the same ratio as the mean brightness.
    """
    return mean_dn * area_px / np.median(area_px)


def body_positions(xy_px: Floats, camera: Camera, surface: LedMap, lever: Lever) -> Floats:
    """Return the (N, 3) positions of lights in body axes, m: eqs 43-44, then from the camera to the bearing.

    Raises
    ------
    ValueError
        If eq. 44 has no root.
    """
    point_cam, _ = thesis_points(camera.rays(xy_px), surface, lever)
    return lever.body_from_cam.apply(point_cam) + lever.camera_body_m


def separation_rad(first: Floats, second: Floats) -> Floats:
    """Return the (...,) angles between (..., 3) unit vectors (eq. 45).

    The angle is computed from half the chord, 2 asin(|u - v| / 2), which is accurate for small angles, unlike the arc
    cosine of eq. 45.
    """
    return 2 * np.arcsin(lengths(first - second) / 2)


def pooled(value: Floats, group: Ints) -> Floats:
    """Return the (G,) sample standard deviation (n - 1) of each group's values over all frames; NaN for a single value.

    Differences between stops count. Section 3.6.3: "across the total number of recorded observations". The "averaged
    multi-positional standard deviation values" of section 4.4.1 would be too small for the position value of Table 9
    (data/published/afit.yaml).

    Parameters
    ----------
    value, group
        (S,) samples, and the group of each: a light or a pair of lights
    """
    return np.sqrt(_covariance(value[:, None], group)[:, 0, 0])


def calibrate(
    sightings: Sequence[Sighting], camera: Camera, surface: LedMap, lever: Lever
) -> HomeCatalog:
    """Return the catalog and its epsilons by AFIT's procedure (Padro 2012, sections 3.6.3-3.6.4 and 4.4.1).

    The numbered steps are those of the module. The catalog is from the frames at home, the epsilons from all frames.

    Parameters
    ----------
    sightings
        Frames with identified lights; the first one is at home
    camera, lever
        Calibrated camera, and its position and orientation
    surface
        Dome model, which gives R; its LEDs are not used

    Raises
    ------
    ImageError
        For inconsistent sightings, or if a standard deviation is undetermined.
    """
    checks.each_of_type("sightings", sightings, Sighting)
    checks.of_type("camera", camera, Camera)
    checks.of_type("surface", surface, LedMap)
    checks.of_type("lever", lever, Lever)
    _check_lights(sightings)
    # 1. Positions in the lab of every light of every frame, with the IMU's attitude
    frame = np.repeat(np.arange(len(sightings)), [len(one.led) for one in sightings])
    ids, xy_px, brightness = (
        np.concatenate([getattr(one, name) for one in sightings])
        for name in ("led", "xy_px", "brightness")
    )
    id_, led = np.unique(ids, return_inverse=True)
    body_m = body_positions(xy_px, camera, surface, lever)
    attitudes = Rotation.concatenate([one.body_from_lab for one in sightings])
    lab_m = attitudes[frame].inv().apply(body_m)
    # 2. Repeatability
    covariance_m2 = _covariance(lab_m, led)
    epsilons = (
        _maximum(pooled(brightness, led), "light"),
        _maximum(np.sqrt(np.einsum("nii->ni", covariance_m2)), "light"),
        _maximum(pooled(*_separations(body_m, frame, led)), "pair of lights"),
    )
    # 3. Catalog of the lights at home, brightest first
    at_home = np.array([one.stop == sightings[0].stop for one in sightings])[frame]
    led = led[at_home]
    count = np.bincount(led)
    columns = (*lab_m[at_home].T, brightness[at_home])
    total = [np.bincount(led, column) for column in columns]
    mean = np.column_stack(total) / np.maximum(count, 1)[:, None]
    # Lights that are not among the samples have a count of 0.
    order = np.argsort(-mean[:, 3], kind="stable")
    order = order[count[order] > 0]
    place_m = mean[order, :3]
    samples = (covariance_m2[order], count[order])
    return HomeCatalog(
        id_[order], normalized(place_m), mean[order, 3], place_m, *samples, *epsilons
    )


def _check_lights(sightings: Sequence[Sighting]) -> None:
    """Raise ImageError for the first sighting whose lights are inconsistent."""
    if not len(sightings):
        raise ImageError("no sightings; allowed: at least two frames")
    for index, sighting in enumerate(sightings):
        count = len(sighting.led)
        if (
            not count
            or sighting.xy_px.shape != (count, 2)
            or sighting.brightness.shape != (count,)
        ):
            raise ImageError(
                f"sighting {index}: {count} ids, centroids {sighting.xy_px.shape}, brightness "
                f"{sighting.brightness.shape}; allowed: K ids, (K, 2) and (K,), K from 1"
            )
        if len(np.unique(sighting.led)) < count:
            raise ImageError(f"sighting {index}: an id occurs twice; allowed: each id once")
        if not (np.isfinite(sighting.xy_px).all() and np.isfinite(sighting.brightness).all()):
            raise ImageError(f"sighting {index}: a centroid or a brightness is not finite")


def _separations(body_m: Floats, frame: Ints, led: Ints) -> tuple[Floats, Ints]:
    """Return the angle about the bearing of every pair in every frame (eq. 45), and its pair's number."""
    # All pairs of each frame
    direction = normalized(body_m)
    first = np.flatnonzero(np.diff(frame)) + 1
    frames = np.split(np.arange(len(led)), first)
    a, b = np.hstack([rows[np.array(np.triu_indices(len(rows), 1))] for rows in frames])
    if not len(a):
        raise ImageError(
            "no frame has two lights; allowed: two or more in a frame, for their separation"
        )
    angle = separation_rad(direction[a], direction[b])
    # One number for each pair of lights, in whichever order they occur
    low, high = np.sort([led[a], led[b]], axis=0)
    _, pair = np.unique(low * (led.max() + 1) + high, return_inverse=True)
    return angle, pair


def _maximum(deviation: Floats, source: str) -> float:
    """Return the largest finite standard deviation. Raises ImageError if there is none."""
    finite = deviation[np.isfinite(deviation)]
    if not len(finite):
        raise ImageError(
            f"each {source} has one sample; allowed: two frames or more, for a standard deviation"
        )
    return float(finite.max())


def _covariance(value: Floats, group: Ints) -> Floats:
    """Return the (G, D, D) sample covariance of each group's values (S, D); NaN for a single value."""
    count = np.bincount(group)
    # Deviations from each group's mean
    mean = np.array([np.bincount(group, column) for column in value.T]) / np.maximum(count, 1)
    difference = value - mean.T[group]
    products = np.einsum("si,sj->sij", difference, difference)
    covariance = summed(products, group, len(count))
    covariance[count < 2] = np.nan
    return covariance / np.maximum(count - 1, 1)[:, None, None]


def led_map(catalog: HomeCatalog, surface: LedMap) -> LedMap:
    """Return a tracker's LED map: the intersections of the catalog's directions from the bearing with the surface.

    Parameters
    ----------
    surface
        Map with the ellipsoid; its LEDs are not used

    Raises
    ------
    ImageError
        If a direction misses the ellipsoid.
    """
    position_m = on_surface(catalog.vectors, np.zeros(3), surface)
    outside = catalog.id[np.isnan(position_m).any(axis=1)]
    if len(outside):
        raise ImageError(
            f"LED {outside[0]}: its direction from the bearing does not intersect the surface"
        )
    return LedMap(catalog.id, position_m, surface.center_m, surface.semi_axes_m)
