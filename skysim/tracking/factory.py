"""The computers on board, as the scene sets them up: the star tracker's, and the one that listens to the gyros."""

from __future__ import annotations

from collections.abc import Mapping

from estimator.catalog import catalog
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError
from skysim.core.paths import CATALOGUES
from skysim.core.types import Frame, Mount, Sources
from skysim.scene.light import BenchConfig, DomeConfig
from skysim.scene.scene import Scene
from skysim.sources.dome import display
from skysim.tracking.external import adapter
from skysim.tracking.external.adapter import ExternalTracker
from skysim.tracking.external.interface import OWN
from skysim.tracking.onboard_model import believed_camera, believed_dome, believed_lever, surveyed_dome
from skysim.tracking.settings import believed_settings

Estimator = StarTracker | DomeTracker | ExternalTracker

NO_PROGRAMS: Mapping[str, str] = {}


def tracker(
    scene: Scene, mount: Mount, sources: Sources, programs: Mapping[str, str] = NO_PROGRAMS
) -> Estimator:
    """The star tracker with what it believes of the hardware: the scene's `tracker` section, else the truth.

    programs : commands by name, any of which `tracker.name` may be
    Raises InputError for a dome that no tracker can work under.
    """
    camera, settings = believed_camera(scene), believed_settings(scene)
    if isinstance(scene.light, DomeConfig):
        leds, lever = believed_dome(scene, scene.light, sources), believed_lever(scene, mount)
        if scene.tracker.map:
            camera, leds, lever = surveyed_dome(scene, scene.tracker.map, leds, lever)
        if scene.tracker.name != OWN:
            return ExternalTracker.of(scene, camera, settings, adapter.leds(leds, lever), programs)
        try:
            return DomeTracker(camera, leds, lever, settings)
        except ImageError as error:
            raise InputError(f"light: the star tracker cannot work under this dome: {error}") from None
    stars = catalog.read(CATALOGUES / f"{scene.light.catalogue}.ecsv")
    stars = catalog.brighter(stars, scene.tracker.limit_mag)
    directions = catalog.apparent(stars, catalog.on_earth(scene.start_time))
    if isinstance(scene.light, BenchConfig):
        # Where the bench has its display decides where the stars are in the lab.
        directions = display.lab_from_icrs(scene.light).apply(directions)
    if scene.tracker.name != OWN:
        return ExternalTracker.of(scene, camera, settings, adapter.stars(stars, directions), programs)
    return StarTracker(camera, stars, directions, settings)


def answer(estimator: Estimator, frame: Frame, streak_px: tuple[float, float] | None = None) -> Report:
    """The tracker's report; a frame that it will not look at (empty, saturated) is a status too.

    streak_px : (dx, dy) that lights move in the exposure, where a gyro tells the tracker
    """
    if isinstance(estimator, ExternalTracker):
        return estimator.look(frame, streak_px)
    try:
        return estimator.solve(frame.image_dn, streak_px)
    except ImageError as error:
        return Report(Attitude(str(error)), Centroids.none())
