"""A star tracker in orbit that gets the camera's velocity from the vehicle's navigation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude, RateEstimate
from estimator.trackers.pipeline import Report, Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.types import Floats
from skysim.scene.scene import Scene
from skysim.sources.orbit.camera_orbit import CameraOrbit, build_orbit, state_at


class OrbitStarTracker(StarTracker):
    """A StarTracker whose attitudes are corrected for the orbit's velocity at each frame.

    Its catalog has the apparent directions of the orbit's start. Since then the velocity has changed by dv, and a star
    in direction u is displaced by (dv - (dv.u) u) / c. About the boresight b this is the rotation b x dv / c, by which
    the attitude is corrected. At an angle a from the boresight up to 5" sin a (10" sin a after half an orbit) is left,
    the same on opposite sides, a change of scale.
    """

    def __init__(
        self,
        camera: Camera,
        stars: catalog.StarCatalog,
        vectors: Floats,
        settings: Settings,
        orbit: CameraOrbit,
    ) -> None:
        super().__init__(camera, stars, vectors, settings)
        self.orbit = orbit
        self.start_m_s = state_at(orbit, 0.0).velocity_m_s

    def solve(
        self,
        image: NDArray[Any],
        streak_px: tuple[float, float] | None = None,
        rate: RateEstimate | None = None,
        exposure_s: float | None = None,
        t_s: float = 0.0,
    ) -> Report:
        """As `StarTracker.solve`; t_s : time of the frame since the orbit's start."""
        report = super().solve(image, streak_px, rate, exposure_s)
        return replace(report, attitude=self.corrected(report.attitude, t_s))

    def corrected(self, attitude: Attitude, t_s: float) -> Attitude:
        """The attitude of a frame at a time since the scene's start."""
        if attitude.cam_from_ref is None:
            return attitude
        boresight = attitude.cam_from_ref.inv().apply([0.0, 0.0, 1.0])
        changed = (
            state_at(self.orbit, t_s).velocity_m_s - self.start_m_s
        ) / catalog.SPEED_OF_LIGHT_M_S
        now_from_start = Rotation.from_rotvec(np.cross(boresight, changed))
        return replace(attitude, cam_from_ref=attitude.cam_from_ref * now_from_start.inv())


def assumed_orbit(scene: Scene) -> CameraOrbit | None:
    """The orbit whose velocity the tracker knows; None on the ground, or if it does not know it."""
    return build_orbit(scene.orbit, scene.start_time) if scene.tracker.orbit_velocity else None


def assumed_observer(scene: Scene, orbit: CameraOrbit | None) -> catalog.Observer:
    """The observer of the tracker's catalog at the scene's start: at the Earth's center, with the `assumed_orbit`'s
    velocity.
    """
    observer = catalog.on_earth(scene.start_time)
    if orbit is None:
        return observer
    return replace(observer, velocity_m_s=observer.velocity_m_s + state_at(orbit, 0.0).velocity_m_s)
