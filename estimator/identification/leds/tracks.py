"""Lights followed from frame to frame, with the brightness of each in the last frames.

Under a dome the points where rays meet a sphere about the bearing turn rigidly with the vehicle, wherever the camera is
on its lever. They are turned by the motion between two frames, from a gyro or else the last one that the lights had,
and projected again; a light continues the track whose prediction is its nearest, and of which it is the nearest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.core.arrays import Floats, Ints
from estimator.core.camera import Camera
from estimator.core.types import Centroids

BORDER_PX = 30.0  # an LED nearer to the border of the sensor may be undetected


class LightTracks:
    """The tracks of a field's lights; T of them, with the last J frames.

    pupil_m   : (3,) of the camera from the bearing, in camera axes;  radius_m : of the sphere about the bearing
    frames    : J
    gate_px   : greatest distance of a light from its prediction
    patience  : successive frames without its light after which a track ends
    goes_dark : whether an LED without light says that its level is 0; it is unknown otherwise

    light, sigma : (T, J) and their errors, NaN without a measurement; frame n is in column n modulo J
    row          : (T,) row of each in the last frame's centroids, -1 without a light
    """

    def __init__(
        self,
        camera: Camera,
        pupil_m: Floats,
        radius_m: float,
        frames: int,
        gate_px: float,
        patience: int,
        goes_dark: bool,
    ) -> None:
        self.camera = camera
        self.pupil_m = pupil_m
        self.radius_m = radius_m
        self.frames = frames
        self.gate_px = gate_px
        self.patience = patience
        self.goes_dark = goes_dark
        self.clear()

    def clear(self) -> None:
        """Forget all lights and their motion."""
        self.point_m = np.empty((0, 3))
        self.light = np.empty((0, self.frames))
        self.sigma = np.empty((0, self.frames))
        self.row = np.empty(0, np.int64)
        self.missed = np.empty(0, np.int64)
        self.rate_rad_s = np.zeros(3)
        self.column = -1

    def advance(
        self,
        centroids: Centroids,
        sigma: Floats,
        elapsed_s: float,
        now_from_then: Rotation | None = None,
    ) -> None:
        """Continue the tracks with a frame's lights, and begin new ones.

        sigma : (N,) errors of the lights' brightness
        now_from_then : cam(now) from cam(last frame), from a gyro
        """
        self.column = (self.column + 1) % self.frames
        turn = now_from_then or Rotation.from_rotvec(self.rate_rad_s * elapsed_s)
        predicted_m = turn.apply(self.point_m)
        xy_px = self.camera.pixels(predicted_m - self.pupil_m)
        seen_m = on_sphere(self.camera.rays(centroids.xy_px), self.pupil_m, self.radius_m)
        self.row = _mutual_nearest(xy_px, centroids.xy_px, self.gate_px)
        self._measure_motion(seen_m, elapsed_s)
        found = self.row >= 0
        self.point_m = np.where(
            found[:, None], seen_m[self.row] if len(seen_m) else predicted_m, predicted_m
        )
        self._record(
            centroids, sigma, self.camera.contains(np.nan_to_num(xy_px, nan=-1e9), BORDER_PX)
        )
        self.missed = np.where(found, 0, self.missed + 1)
        self._keep(
            found
            | (
                (self.missed <= self.patience)
                & self.camera.contains(np.nan_to_num(xy_px, nan=-1e9))
            )
        )
        self._begin(centroids, sigma, seen_m)

    def _measure_motion(self, seen_m: Floats, elapsed_s: float) -> None:
        """The rate of the lights between the last two frames, in camera axes; unchanged unless two are seen in both."""
        found = self.row >= 0
        if found.sum() >= 2 and elapsed_s > 0:
            turn, _ = Rotation.align_vectors(seen_m[self.row[found]], self.point_m[found])
            self.rate_rad_s = turn.as_rotvec() / elapsed_s

    def _record(self, centroids: Centroids, sigma: Floats, inside: NDArray[np.bool_]) -> None:
        """Store the brightness of each track; 0 for an LED that is dark well inside the field."""
        found = self.row >= 0
        dark = ~found & inside & self.goes_dark
        self.light[:, self.column] = np.where(dark, 0.0, np.nan)
        self.sigma[:, self.column] = np.nan
        self.light[found, self.column] = centroids.flux[self.row[found]]
        self.sigma[found, self.column] = sigma[self.row[found]]
        # A dark frame is as uncertain as the others, whose errors are those of the light itself.
        with np.errstate(invalid="ignore"):
            greatest = np.fmax.reduce(self.sigma, axis=1, initial=0.0)
        self.sigma[dark, self.column] = greatest[dark]

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        for name in ("point_m", "light", "sigma", "row", "missed"):
            setattr(self, name, getattr(self, name)[kept])

    def _begin(self, centroids: Centroids, sigma: Floats, seen_m: Floats) -> None:
        """New tracks for the lights that continue none."""
        new = np.setdiff1d(np.arange(len(centroids)), self.row)
        nothing = np.full((len(new), self.frames), np.nan)
        self.point_m = np.vstack([self.point_m, seen_m[new]])
        self.light, self.sigma = np.vstack([self.light, nothing]), np.vstack([self.sigma, nothing])
        self.row = np.concatenate([self.row, new])
        self.missed = np.concatenate([self.missed, np.zeros(len(new), np.int64)])
        first = len(self.row) - len(new)
        self.light[first:, self.column] = centroids.flux[new]
        self.sigma[first:, self.column] = sigma[new]


def _mutual_nearest(predicted_px: Floats, seen_px: Floats, gate_px: float) -> Ints:
    """(T,) row of the light nearest to each prediction, if both are each other's nearest within the gate, else -1."""
    row = np.full(len(predicted_px), -1)
    if not len(predicted_px) or not len(seen_px):
        return row
    distance = np.linalg.norm(predicted_px[:, None] - seen_px, axis=2)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    track = np.arange(len(row))
    good = (distance.argmin(axis=0)[nearest] == track) & (distance[track, nearest] <= gate_px)
    row[good] = nearest[good]
    return row
