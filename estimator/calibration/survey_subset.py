"""What sightings determine: the connected subset of a dome survey's lights and frames, and how accurately.

Of a bundle adjustment's covariance, which is that of the errors against the truth, only the diagonal blocks of lights
and attitudes are computed, and the block of lever and lens.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, eigh, solve_triangular
from scipy.sparse import bsr_array, csr_array

from estimator.calibration import bundle_adjustment as ba
from estimator.calibration.bundle_adjustment import (
    Bundle,
    NormalEquations,
    Sightings,
    eliminate_lights,
)
from estimator.core.checks import Bools, Floats, Ints, frozen
from estimator.core.vectors import lengths, normalized

# Least rms angle of the rays to one light from their main direction; below it, the distance is undetermined.
CROSSING_RAD = 0.005
# The same for lights that connect frames before they are adjusted, when the angle is not yet exact.
CONNECTING_RAD = 2 * CROSSING_RAD


@frozen
class Subset:
    """Connected subset of lights, frames and sightings, renumbered from 0.

    Attributes
    ----------
    bundle, sightings
        Parameters and observations of the subset
    led, frame, index
        Rows of its lights, frames and sightings in the full set
    """

    bundle: Bundle
    sightings: Sightings
    led: Ints
    frame: Ints
    index: Ints

    @property
    def terms(self) -> ba.NormalEquations:
        """Normal equations of its least-squares fit."""
        return self.bundle.equations(self.sightings, np.ones(len(self.index)))

    def insert_into(self, full: Bundle, fitted: Bundle) -> Bundle:
        """Return the full bundle with the adjusted values of this subset inserted."""
        # Lights and frames outside of the subset keep their values.
        position = full.position_m.copy()
        rotated = full.R_body_from_lab.copy()
        position[self.led] = fitted.position_m
        rotated[self.frame] = fitted.R_body_from_lab
        return replace(fitted, position_m=position, R_body_from_lab=rotated, map_m=full.map_m)


class Unconnected(ValueError):
    """Error: the frames form several groups.

    Attributes
    ----------
    frames
        Rows of the frames outside the group of the frame with most LEDs
    """

    def __init__(self, message: str, frames: Ints) -> None:
        super().__init__(message)
        self.frames = frames


def connected_subset(
    full: Bundle, sightings: Sightings, keep: np.ndarray | bool = True
) -> Subset:
    """Return the subset that the sightings determine.

    1. Remove lights seen in fewer than two frames or without crossing rays, and frames that see fewer than two of the
       remaining lights, until nothing changes.
    2. Check that the coordinates suffice for the unknowns, and that the frames form one group.
    3. Renumber lights, frames and sightings from 0.

    Raises
    ------
    ValueError
        If too few sightings remain.
    Unconnected
        If they form groups of frames that are not connected.
    """
    in_front = np.isfinite(ba.residuals(full, sightings)).all(axis=1)
    index = np.flatnonzero(keep & in_front)
    lights = len(full.position_m)
    frames = len(full.R_body_from_lab)
    camera_m = np.einsum("kji,j->ki", full.R_body_from_lab, full.camera_body_m)  # in the lab
    # 1. Removing a light can leave its frames with too few lights, and the reverse.
    while True:
        led = sightings.led[index]
        frame = sightings.frame[index]
        incidence = csr_array((np.ones(len(index)), (frame, led)), shape=(frames, lights)) > 0
        angle_rad = ray_angles(full.position_m, camera_m, frame, led)
        good_led = (incidence.sum(axis=0) >= 2) & (angle_rad > CROSSING_RAD)
        good_frame = incidence @ good_led.astype(float) >= 2
        valid = good_led[led] & good_frame[frame]
        if valid.all():
            break
        index = index[valid]
    # 2. Coordinates and connection
    led_rows = np.unique(led)
    frame_rows = np.unique(frame)
    unknowns = 3 * len(led_rows) + 3 * len(frame_rows) + 3 + full.free_lens - 4
    if 2 * len(index) < unknowns or not len(index):
        raise ValueError(
            f"survey: {2 * len(index)} usable coordinates for {unknowns} unknowns; take more frames"
        )
    _check_one_group(incidence, frame_rows)
    # 3. New numbers
    numbered = replace(
        sightings.take(index),
        frame=np.searchsorted(frame_rows, frame),
        led=np.searchsorted(led_rows, led),
    )
    bundle = replace(
        full,
        position_m=full.position_m[led_rows],
        R_body_from_lab=full.R_body_from_lab[frame_rows],
        map_m=full.map_m[led_rows],
    )
    return Subset(bundle, numbered, led_rows, frame_rows, index)


def ray_angles(
    position_m: np.ndarray, camera_m: np.ndarray, frame: Ints, led: Ints
) -> np.ndarray:
    """Return the (N,) rms angle of the rays to each light from their main direction; the distance depends on it.

    The mean sin^2 of these angles is 1 minus the largest eigenvalue of the mean of u u^T. Without a sighting it is 0.

    Parameters
    ----------
    position_m
        (N, 3) positions of the lights
    camera_m
        (F, 3) positions of the camera in each frame
    frame, led
        (K,) rows of each sighting's frame and light
    """
    ray = normalized(position_m[led] - camera_m[frame])
    lights = len(position_m)
    count = np.bincount(led, minlength=lights)
    scatter = ba.summed(ray[:, :, None] * ray[:, None, :], led, lights)
    largest = np.linalg.eigvalsh(scatter / np.maximum(count, 1)[:, None, None])[:, 2]
    return np.sqrt(np.where(count > 0, np.maximum(1 - largest, 0.0), 0.0))


def connected_group(visible: Bools, first: int, min_shared: int) -> Bools:
    """(F,) frames of a table (F, N) of lights that share so many with the others of the group that begins with one."""
    group = np.arange(len(visible)) == first
    while True:
        shared = visible & visible[group].any(axis=0)
        grown = group | (shared.sum(axis=1) >= min_shared)
        if (grown == group).all():
            return group
        group = grown


def _check_one_group(incidence: csr_array, frame_rows: Ints) -> None:
    """Raise Unconnected unless the frames form one group, each sharing two or more lights with the rest.

    A group that shares only one light with the rest could rotate about it. The group grows from the frame with the most
    lights.
    """
    # Frames by lights; the group begins with the frame with the most lights.
    table = incidence[frame_rows].toarray()
    member = connected_group(table, int(np.argmax(table.sum(axis=1))), 2)
    # The message names one frame of the group and one outside it.
    if not member.all():
        first = frame_rows[member][0]
        second = frame_rows[~member][0]
        raise Unconnected(
            f"survey: the frames are not connected; {np.sum(~member)} of {len(member)}, frame {second} first, share "
            f"fewer than two LEDs with the group of frame {first}: take frames between them",
            frame_rows[~member],
        )


# Covariance of a bundle adjustment: of the errors against the truth.


COMMON = 3  # number of errors common to all lights, besides those of lever and lens


class Covariances(NamedTuple):
    """Diagonal blocks of the covariance.

    Attributes
    ----------
    by_led
        (N, 3, 3) covariance of each light's position, m^2, in the lab frame
    by_rotation
        (F, 3, 3) covariance of each attitude, rad^2, in body axes
    shared
        (3 + free_lens, 3 + free_lens) covariance of the lever and the free lens elements
    """

    by_led: Floats
    by_rotation: Floats
    shared: Floats


def covariance(terms: NormalEquations, bundle: Bundle) -> Covariances:
    """Return the diagonal blocks of the inverse normal matrix: A^-1 + S Q S^T of the lights, S = A^-1 B, Q of the rest.

    Raises
    ------
    LinAlgError
        If an unknown is undetermined.
    """
    # Q, the inverse of the scaled Schur complement: the covariance of all but the lights
    reduced = eliminate_lights(terms, 0.0)
    scale = reduced.scale
    rest = cho_solve(reduced.factor, np.eye(len(scale))) * scale * scale[:, None]
    size = len(rest)
    frames = len(bundle.R_body_from_lab)
    elimination = reduced.elimination.toarray()  # S
    product = (elimination @ rest).reshape(-1, 3, size)
    by_led = np.einsum("nik,njk->nij", product, elimination.reshape(-1, 3, size))
    by_rotation = np.array(
        [rest[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(frames)]
    )
    shared = rest[3 * frames :, 3 * frames :]
    return Covariances(by_led + reduced.inverse_led.data, by_rotation, shared)


def common_errors(terms: NormalEquations, bundle: Bundle) -> tuple[Floats, Floats]:
    """Return the errors that the lights share: changes by one standard deviation of each of M independent errors.

    These are (M, N, 3) of the positions, m, and (M, 3 + free_lens) of the lever and the free lens elements. All
    unknowns but the lights err by y = L z, with L L^T their covariance and z standard normal. The lights err by -S y,
    S = A^-1 B, and each by an independent error of covariance A^-1. A rotation of z changes no covariance (principal
    components: Jolliffe 2002, Principal Component Analysis, chapter 2):

    1. Compute L from the Cholesky factor.
    2. The first elements of z are those that change lever and lens.
    3. The next COMMON ones turn the directions of the lights from the bearing most: in general a rotation of the map.

    What the other elements add to the lights' own covariances is local. Taken as independent, it leaves 1 % of an
    attitude's variance out.
    """
    # 1. L
    reduced = eliminate_lights(terms, 0.0)
    unit = np.eye(len(reduced.scale))
    root = solve_triangular(reduced.factor[0], unit, trans="T", lower=True)
    root *= reduced.scale[:, None]
    # 2. Lever and lens
    shared = slice(3 * len(bundle.R_body_from_lab), None)
    first = np.linalg.qr(root[shared].T)[0]
    # 3. Directions of the lights
    radius_m = lengths(bundle.position_m)[:, None, None]
    along = (bundle.position_m / radius_m[:, 0])[:, :, None]
    start = np.arange(len(along) + 1)
    across = bsr_array(((np.eye(3) - along * along.mT) / radius_m, start[:-1], start))
    turned = across @ reduced.elimination
    others = root @ (unit - first @ first.T)
    variance = others.T @ (turned.T @ turned).toarray() @ others
    _, next_ = eigh(variance, subset_by_index=(len(unit) - COMMON, len(unit) - 1))
    change = root @ np.column_stack([first, next_])
    position_m = -(reduced.elimination @ change)
    return position_m.T.reshape(-1, len(along), 3), change[shared].T
