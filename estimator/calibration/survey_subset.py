"""Connected subset of a dome survey: the lights and frames that the sightings determine."""

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from estimator.calibration import bundle_adjustment as ba
from estimator.calibration.bundle_adjustment import Bundle, Sightings
from estimator.core.checks import Ints, frozen
from estimator.core.vectors import normalized

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


def _check_one_group(incidence: csr_array, frame_rows: Ints) -> None:
    """Raise Unconnected unless the frames form one group, each sharing two or more lights with the rest.

    A group that shares only one light with the rest could rotate about it. The group grows from the frame with the most
    lights.
    """
    # Frames by lights; the group begins with the frame with the most lights.
    table = incidence[frame_rows].astype(float)
    member = np.zeros(len(frame_rows), dtype=bool)
    member[np.argmax(table.sum(axis=1))] = True
    while True:
        leds_in_group = (table.T @ member.astype(float)) > 0
        grown = member | (table @ leds_in_group.astype(float) >= 2)
        if (grown == member).all():
            break
        member = grown
    # The message names one frame of the group and one outside it.
    if not member.all():
        first = frame_rows[member][0]
        second = frame_rows[~member][0]
        raise Unconnected(
            f"survey: the frames are not connected; {np.sum(~member)} of {len(member)}, frame {second} first, share "
            f"fewer than two LEDs with the group of frame {first}: take frames between them",
            frame_rows[~member],
        )
