"""Run a scene from Python: `simulate` is the equivalent of `skysim run` and `render` of `skysim render`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame, Trajectory, Truth
from skysim.results.run import Run, run_of
from skysim.results.scoring import Score
from skysim.scene.scene import Scene, check_scene
from skysim.simulation import timing
from skysim.simulation.exposure import render_frame
from skysim.simulation.flight import Progress, open_flight
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking.factory import NO_PROGRAMS

KNOTS = 9  # samples of the attitude in the exposure of `render_at`


def simulate(
    scene: Scene,
    *,
    controller: Any = None,
    tracker: Any = None,
    profile: Any = None,
    programs: Mapping[str, str] = NO_PROGRAMS,
    progress: Progress | None = None,
) -> Run:
    """Simulate a scene's motion, render every frame, solve it and score the solution against the truth.

    All frames are kept in memory; `skysim run` writes them one by one. Raises InputError.

    Parameters
    ----------
    controller
        In place of the scene's: its name, or a callable that takes a `ControllerSetup` and
        returns the law, a callable that takes a `ControllerInput` and returns the torque (3,)
        in N m (docs/howto/controller.md)
    tracker
        In place of the scene's: its name, a `StarTracker` or `DomeTracker` of the estimator, or
        a function that takes an image (H, W) and returns the attitude cam_from_ref as a
        Rotation, a unit quaternion (4,) scalar last or an `Answer`, or None for no attitude.
        The reference is the ICRS under the stars, else the lab
    profile
        In place of the scene's start and maneuvers: an attitude file, or an astropy Table,
        pandas DataFrame or mapping of columns (docs/howto/profile.md). The scene's controller
        follows it; without one the vehicle moves exactly along it
    programs
        Commands of external trackers and controllers by name
    progress
        Called as progress(t_s, duration_s) during the flight
    """
    with open_flight(
        scene, controller=controller, tracker=tracker, profile=profile, programs=programs
    ) as flight:
        scores: dict[str, list[Score]] = {camera.name: [] for camera in flight.lab.cameras}
        for shot in flight.shots(progress=progress):
            scores[shot.camera.name].append(Score(shot))
        return run_of(flight, list(scores.values()))


def render(scene: Scene, index: int = 0) -> tuple[Frame, Truth]:
    """One frame of a scene with its truth, bit-identical to that frame of the complete run.

    Earlier frames are not rendered, except with a `filter` section or exposure control, where a frame depends on
    them. Raises InputError for an index outside the scene's frames.
    """
    check_scene(scene)
    frames = scene.exposure.frames
    if not 0 <= index < frames:
        raise InputError(
            "index", f"{index} is outside of the scene's frames", f"0 to {frames - 1}"
        )
    needs_all = scene.filter is not None or scene.tracker.exposure_control is not None
    with open_flight(scene) as flight:
        shots = flight.shots(
            solves=False, selects=None if needs_all else lambda number, _: number == index
        )
        return next(
            (shot.frame, shot.truth)
            for shot in shots
            if shot.frame.index == index and shot.camera is flight.lab.camera
        )


def render_at(
    scene: Scene | Lab,
    lab_from_body: Rotation,
    rate_body_rad_s: Floats | tuple[float, float, float] = (0.0, 0.0, 0.0),
    t_s: float = 0.0,
    index: int = 0,
    camera: int = 0,
) -> tuple[Frame, Truth]:
    """One frame for a plant outside of skysim: the vehicle's attitude and rate are the caller's.

    Parameters
    ----------
    scene
        Or a lab of `skysim.build_lab`, which is then not built for every frame
    lab_from_body, rate_body_rad_s
        Attitude at mid-exposure, and rate (3,) in body axes, constant in the exposure
    t_s
        Time of mid-exposure since the scene's start
    index
        Number of the frame. It selects the noise, which is independent between frames of
        different numbers

    Raises
    ------
    InputError
        For a negative number, and for a camera that the lab does not have.
    """
    lab = build_lab(scene) if not isinstance(scene, Lab) else scene
    if index < 0:
        raise InputError("index", f"{index} is negative", "0 or more")
    if not 0 <= camera < len(lab.cameras):
        raise InputError(
            "camera", f"{camera} is none of the lab's", f"0 to {len(lab.cameras) - 1}"
        )
    own = lab.cameras[camera]
    window = timing.window_from(own.scene, 0.0)
    window = window._replace(open_s=t_s - window.middle_s)
    times_s = np.linspace(
        window.open_s - timing.MARGIN_S, window.close_s + timing.MARGIN_S, KNOTS
    )
    rate = np.asarray(rate_body_rad_s, dtype=np.float64)
    return render_frame(
        own, Trajectory.at_rate(lab_from_body, rate, t_s, times_s), index, None, window
    )
