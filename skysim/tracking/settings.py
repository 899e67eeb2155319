"""Settings of the tracker from a scene; the names of algorithms are checked here."""

from __future__ import annotations

from collections.abc import Mapping

from estimator.attitude.nearfield import SOLVERS as NEAR_SOLVERS
from estimator.attitude.solvers import SOLVERS
from estimator.centroiding.centroid import CENTROIDERS
from estimator.detection.detect import DETECTORS
from estimator.identification.registry import IDENTIFIERS
from estimator.trackers.dome_tracker import IDENTIFIERS as NEAR_IDENTIFIERS
from estimator.trackers.pipeline import Settings
from skysim.camera.detector.detector import saturation_dn
from skysim.core.errors import InputError
from skysim.core.units import require_member
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene


def believed_settings(scene: Scene) -> Settings:
    """The tracker's algorithms and thresholds as the scene sets them. Raises InputError for an unknown name.

    What the scene leaves out depends on the light: a dome uses the local detector, centers of gravity and LED pairs.
    """
    part, usual = scene.tracker, Settings()
    near = isinstance(scene.light, DomeConfig)
    return Settings(
        max_blobs=part.brightest or usual.max_blobs,
        base_stars=min(part.brightest or usual.base_stars, usual.base_stars),
        detector=known("detector", part.detector or ("local" if near else "default"), DETECTORS),
        centroider=known("centroider", part.centroider or ("cog" if near else "default"), CENTROIDERS),
        identifier=known(
            "identifier",
            part.identifier or ("led_pairs" if near else "default"),
            NEAR_IDENTIFIERS if near else IDENTIFIERS,
        ),
        solver=known(
            "solver",
            part.solver or ("rotation_only" if near else "default"),
            NEAR_SOLVERS if near else SOLVERS,
        ),
        threshold_sigma=part.threshold_sigma,
        min_area_px=part.min_area_px,
        gain_e_dn=scene.camera.detector.gain_e_dn,
        saturation=saturation_dn(scene.camera.detector),
        centroid_sigma_px=part.centroid_sigma_px,
    )


def choices(scene: Scene) -> dict[str, tuple[str, ...]]:
    """All algorithms that a scene's tracker may name, by stage."""
    near = isinstance(scene.light, DomeConfig)
    return {
        "detector": tuple(DETECTORS),
        "centroider": tuple(CENTROIDERS),
        "identifier": tuple(NEAR_IDENTIFIERS if near else IDENTIFIERS),
        "solver": tuple(NEAR_SOLVERS if near else SOLVERS),
    }


def known(key: str, name: str, algorithms: Mapping[str, object]) -> str:
    """Return the name if it is one of the algorithms, else raise InputError.

    Only the estimator has the list, and the scene package may not import it, so the name is checked here.
    """
    try:
        return require_member(name, algorithms)
    except ValueError as error:
        raise InputError(f"tracker.{key}: {error}") from None
