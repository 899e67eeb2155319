"""Select the sources in view and project them through the lens over an exposure: steps 1 and 2 of the smear integral.

The camera rotates about the lab's origin, the bearing's center, so its poses follow from the trajectory alone. LEDs are
places and have parallax on the camera's lever arm; stars are directions.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from skysim.camera.optics import Optics
from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, Ints, Mount, Sources, StarSources, Trajectory
from skysim.scene.sections.camera import CameraConfig
from skysim.sources.dome.led import Emitter, irradiance_e_s_m2

# Number of poses in an exposure.
MIN_POSES = 9
MAX_POSES = 32_769
# In a catalog with fewer stars a test of every star takes less than 50 us.
MIN_BAND_STARS = 20_000
# Fraction of the sky up to which a look-up of the stars by direction is faster than a test of every star.
MAX_BAND_SHARE = 0.1
NOW = np.zeros(1)  # at mid-exposure
NO_MOTION = np.empty((0, 2, 3))  # for sources at rest


class Poses(NamedTuple):
    """The camera's pose at K times.

    Attributes
    ----------
    cam_from_lab
        (K, 3, 3) rotation matrices
    camera_m
        (K, 3) positions of the entrance pupil, lab frame
    """

    cam_from_lab: Floats
    camera_m: Floats


class Tracks(NamedTuple):
    """Image position and rate of every source at K even times of the exposure, as arrays for numba.

    Attributes
    ----------
    first_s, step_s
        Time of the first sample and interval between samples
    xy_px
        (K, N, 2) positions of the images, NaN where a source has none
    rate_e_s
        (K, N) photo-electrons per second while the source is lit
    pulse_s
        (N, 3) period, start and duration of the source's pulses
    """

    first_s: float
    step_s: float
    xy_px: Floats
    rate_e_s: Floats
    pulse_s: Floats


def sample_times(open_s: float, close_s: float, trajectory: Trajectory) -> Floats:
    """K even times over the exposure, as dense as the attitude's samples; K is odd, so one is at mid-exposure.

    Raises
    ------
    InputError
        For more samples than memory should hold: dropping samples could drop the jitter.
    """
    first, last = np.searchsorted(trajectory.t_s, (open_s, close_s))
    # `| 1` makes the count odd.
    count = max(int(last - first) + 1, MIN_POSES) | 1
    if count > MAX_POSES:
        raise InputError(
            "exposure.time",
            f"{close_s - open_s:g} s holds {count} samples of the attitude",
            f"{MAX_POSES}, a shorter exposure or slower jitter",
        )
    return np.linspace(open_s, close_s, count)


def poses(trajectory: Trajectory, mount: Mount, t_s: Floats) -> Poses:
    """The camera's poses at K times.

    cam_from_lab = cam_from_body body_from_lab; the pupil is at lab_from_body applied to its place on the body, since
    the lab's origin is the bearing's center.
    """
    lab_from_body = trajectory.attitude_at(t_s).as_matrix()
    cam_from_lab = mount.cam_from_body.as_matrix() @ lab_from_body.transpose(0, 2, 1)
    return Poses(cam_from_lab, lab_from_body @ mount.camera_body_m)


def image_tracks(
    sources: Sources, optics: Optics, poses: Poses, t_s: Floats, emitter: Emitter
) -> tuple[Tracks, Floats, Floats]:
    """Project N sources over the exposure.

    Returns their tracks, their mean distances (N,) in m (1 for stars) and mean field-angle cosines (N,).
    """
    # Motions of sources are given about mid-exposure.
    # Positions and geometry at every time, then the rates.
    xy, distance_m, cos_out, cos_in = project(
        sources, optics, poses, t_s - t_s[len(t_s) // 2]
    )
    rate_e_s = rates_e_s(sources, optics, emitter, distance_m, cos_out, cos_in)
    pulse_s = np.column_stack([sources.period_s, sources.start_s, sources.on_s])
    tracks = Tracks(float(t_s[0]), float(t_s[1] - t_s[0]), xy, rate_e_s, pulse_s)
    return tracks, distance_m.mean(axis=0), cos_in.mean(axis=0)


def rates_e_s(
    sources: Sources,
    optics: Optics,
    emitter: Emitter,
    distance_m: Floats,
    cos_out: Floats,
    cos_in: Floats,
) -> Floats:
    """(..., N) photo-electrons per second of N lit sources, from what `project` returns.

    A star gives strength T(theta) A; an LED its irradiance at the pupil, by the laws of its lobe and of distance, times
    A. T is the throughput at the field angle theta, A the collecting area.
    """
    # Stars first; the rows of LEDs are replaced.
    throughput = optics.throughput(cos_in)
    rate = sources.strength * throughput
    is_led = sources.place[:, 3] > 0
    if is_led.any():
        rate = np.where(
            is_led,
            irradiance_e_s_m2(sources.strength, emitter, cos_out, throughput, distance_m),
            rate,
        )
    return rate * optics.collecting_m2


def project(
    sources: Sources, optics: Optics, poses: Poses, after_s: Floats = NOW
) -> tuple[Floats, Floats, Floats, Floats]:
    """Project N sources at each of K poses, (K,) seconds after mid-exposure, each in its color.

    Returns (K, N, 2) pixels, (K, N) distances in m (1 for stars), (K, N) cosines of the angles at the emitter (from its
    normal) and at the aperture (from the boresight).
    """
    motion = NO_MOTION if sources.motion is None else sources.motion
    cam_from_lab, camera_m = map(np.ascontiguousarray, poses)
    direction_cam, distance, cos_out = _directions(
        sources.place, motion, after_s, sources.normal, cam_from_lab, camera_m
    )
    xy_px = _pixels(sources, optics, direction_cam, distance)
    return xy_px, distance, cos_out, direction_cam[:, :, 2]


def project_each(
    sources: Sources, optics: Optics, poses: Poses, ends: Ints
) -> tuple[Floats, ...]:
    """Project sources in K groups, each group at a pose of its own, at mid-exposure.

    Returns the quantities of `project` for each source once: (N, 2) and three times (N,).

    Parameters
    ----------
    ends
        (K + 1,) row of the first source of each group, and the number of sources
    """
    direction_cam, distance, cos_out = _directions_each(
        sources.place, NO_MOTION, NOW, sources.normal, *poses, ends
    )
    xy_px = _pixels(sources, optics, direction_cam, distance)
    return xy_px, distance, cos_out, direction_cam[:, 2]


def _pixels(
    sources: Sources, optics: Optics, direction_cam: Floats, distance_m: Floats
) -> Floats:
    """(..., N, 2) pixels of (..., N, 3) directions at distances (..., N); lateral color displaces each radially."""
    if any(optics.camera.pupil_walk_m):
        direction_cam = optics.from_pupil(direction_cam, sources.place[:, 3] / distance_m)
    xy_px = optics.project(direction_cam)
    if sources.chromatic is not None:
        xy_px = lateral_color(optics.camera, xy_px, sources.chromatic)
    return beside_edges(optics.camera, xy_px)


def lateral_color(camera: CameraConfig, xy_px: Floats, chromatic: Floats) -> Floats:
    """Move images (..., N, 2) along their radii by their mean color (N, 4), as the distance from the center."""
    return xy_px + camera.along_radius("lateral", chromatic[:, 1:2], xy_px)


def beside_edges(camera: CameraConfig, xy_px: Floats) -> Floats:
    """(..., 2) pixels that collect the light at xy_px (..., 2): x + A (exp(-d_high / L) - exp(-d_low / L)).

    The field of the guard ring bends the paths of charge at the distances d from a chip's edges (Plazas, Bernstein &
    Sheldon 2014, PASP 126, 750: an exponential of 1 px and more).
    """
    detector = camera.detector
    if not detector.edge_px:
        return xy_px
    from_low_px = xy_px + 0.5
    from_high_px = camera.size_px - from_low_px
    reach_px = detector.edge_reach_px
    bend = np.exp(-np.abs(from_high_px) / reach_px) - np.exp(-np.abs(from_low_px) / reach_px)
    return xy_px + detector.edge_px * bend


@jit
def _directions(
    place: Floats,
    motion: Floats,
    after_s: Floats,
    normal: Floats,
    cam_from_lab: Floats,
    camera_m: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Directions from the entrance pupil to N sources at K poses.

    A source has a homogeneous place (p, w): w = 1 for an LED at p, w = 0 for a star in the direction p. Its offset from
    the pupil c is o = p - w c + v t + a t^2 / 2, so a star has no parallax.

    Parameters
    ----------
    motion
        (N, 2, 3) velocity v and acceleration a, as in `Sources`, or (0, 2, 3) where nothing moves
    after_s
        (K,) times t after mid-exposure, or (1,) for all poses

    Returns
    -------
    tuple
        (K, N, 3) unit directions in camera axes, (K, N) distances |o| in m, (K, N) cosines of the angles between the
        emitter's normal and the direction to the camera
    """
    poses = len(cam_from_lab)
    count = len(place)
    moves = len(motion) > 0
    direction = np.empty((poses, count, 3))
    distance = np.empty((poses, count))
    cosine = np.empty((poses, count))
    offset = np.empty(3)
    for k in range(poses):
        t = after_s[min(k, len(after_s) - 1)]
        for n in range(count):
            # Offset from the pupil, and its length.
            square = 0.0
            for i in range(3):
                offset[i] = place[n, i] - place[n, 3] * camera_m[k, i]
                if moves:
                    offset[i] += t * (motion[n, 0, i] + t / 2 * motion[n, 1, i])
                square += offset[i] * offset[i]
            distance[k, n] = math.sqrt(square)
            # Unit direction, and its angle with the emitter's normal.
            outward = 0.0
            for i in range(3):
                offset[i] /= distance[k, n]
                outward += offset[i] * normal[n, i]
            cosine[k, n] = -outward
            # From the lab's axes to the camera's.
            for i in range(3):
                turned = 0.0
                for j in range(3):
                    turned += cam_from_lab[k, i, j] * offset[j]
                direction[k, n, i] = turned
    return direction, distance, cosine


@jit
def _directions_each(
    place: Floats,
    motion: Floats,
    after_s: Floats,
    normal: Floats,
    cam_from_lab: Floats,
    camera_m: Floats,
    ends: Ints,
) -> tuple[Floats, Floats, Floats]:
    """As `_directions`, for sources in groups, each at a pose of its own: (N, 3), (N,) and (N,)."""
    direction = np.empty((len(place), 3))
    distance = np.empty(len(place))
    cosine = np.empty(len(place))
    for k in range(len(ends) - 1):
        a = ends[k]
        b = ends[k + 1]
        # One pose for the sources a to b.
        own = _directions(
            place[a:b],
            motion,
            after_s,
            normal[a:b],
            cam_from_lab[k : k + 1],
            camera_m[k : k + 1],
        )
        direction[a:b] = own[0][0]
        distance[a:b] = own[1][0]
        cosine[a:b] = own[2][0]
    return direction, distance, cosine


def in_view(sources: Sources, optics: Optics, poses: Poses, reach: float = 0.25) -> Ints:
    """Rows of the sources within a cone about the boresight at any of these poses.

    The cone's half-angle is the sum of the field's half-diagonal, a fraction `reach` of it for images that reach in
    from outside, and half of the largest rotation between successive poses, for sources that cross the field between
    them. Stars in a small part of the sky are looked up by direction, so the time grows with the number of stars in the
    field and not in the catalog.
    """
    boresight = np.ascontiguousarray(poses.cam_from_lab[:, 2])
    # The greatest angles between successive boresights, and between any boresight and the first.
    cosines = (np.vecdot(boresight[1:], boresight[:-1]), boresight @ boresight[0])
    rotation_rad, span_rad = (
        math.acos(min(max(cosine.min(initial=1.0), -1.0), 1.0)) for cosine in cosines
    )
    half_rad = (1 + reach) * optics.field_rad + 0.02 + rotation_rad / 2
    cos_limit = math.cos(min(half_rad, math.pi))
    cos_any = math.cos(min(half_rad + span_rad, math.pi))
    place = sources.place
    camera_m = np.ascontiguousarray(poses.camera_m)
    # A cap of half-angle h covers (1 - cos h) / 2 of the sky.
    by_band = len(sources) >= MIN_BAND_STARS and (1 - cos_any) / 2 <= MAX_BAND_SHARE
    if by_band and isinstance(sources, StarSources):
        near = sources.within(boresight[0], half_rad + span_rad)
        return near[_in_cone(place[near], boresight, camera_m, cos_limit, cos_any)]
    return np.flatnonzero(_in_cone(place, boresight, camera_m, cos_limit, cos_any))


@jit
def _in_cone(
    place: Floats, boresight: Floats, camera_m: Floats, cos_limit: float, cos_any: float
) -> Any:
    """(N,) whether a source is within the cone about the boresight of any of K cameras.

    It is within a cone if the cosine with the boresight is above `cos_limit`. A star whose cosine with the first
    boresight is below `cos_any` is in none of the cones.
    """
    inside = np.zeros(len(place), np.bool_)
    first = boresight[0]
    for n in range(len(place)):
        # A star far from the first boresight needs no test against the others.
        at_first = place[n, 0] * first[0] + place[n, 1] * first[1] + place[n, 2] * first[2]
        if place[n, 3] == 0 and at_first < cos_any:
            continue
        for k in range(len(boresight)):
            # o . b > |o| cos(limit), with the offset o from the camera and the boresight b.
            along = 0.0
            square = 0.0
            for i in range(3):
                offset = place[n, i] - place[n, 3] * camera_m[k, i]
                along += offset * boresight[k, i]
                square += offset * offset
            if along > cos_limit * math.sqrt(square):
                inside[n] = True
                break
    return inside
