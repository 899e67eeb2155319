"""Settings of the tracker from a scene; the names of algorithms are checked here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from estimator.attitude.nearfield import SOLVERS as NEAR_SOLVERS
from estimator.attitude.solvers import SOLVERS
from estimator.centroiding.centroid import CENTROIDERS
from estimator.detection.detect import DETECTORS
from estimator.identification.registry import IDENTIFIERS
from estimator.trackers.dome_tracker import IDENTIFIERS as NEAR_IDENTIFIERS
from estimator.trackers.pipeline import Settings
from skysim.camera.detector.detector import saturation_dn
from skysim.core.errors import InputError, unknown_name
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig

DOME_ALGORITHMS = {
    "detector": "local",
    "centroider": "cog",
    "identifier": "led_pairs",
    "solver": "rotation_only",
}  # defaults under a dome; "default" under stars
STAR_ALGORITHMS: dict[str, Mapping[str, object]] = {
    "detector": DETECTORS,
    "centroider": CENTROIDERS,
    "identifier": IDENTIFIERS,
    "solver": SOLVERS,
}


def assumed_settings(scene: Scene) -> Settings:
    """The tracker's algorithms and thresholds as the scene sets them. Raises InputError for an unknown name.

    Defaults depend on the light: a dome uses the local detector, centers of gravity and LED pairs.
    """
    config = scene.tracker
    default = Settings()
    usual = DOME_ALGORITHMS if isinstance(scene.light, DomeConfig) else {}
    chosen: dict[str, Any] = {
        stage: require_algorithm(
            stage, getattr(config, stage) or usual.get(stage, "default"), table
        )
        for stage, table in algorithm_tables(scene).items()
    }
    return Settings(
        max_blobs=config.brightest or default.max_blobs,
        base_stars=min(config.brightest or default.base_stars, default.base_stars),
        searched_stars=min(config.brightest or default.searched_stars, default.searched_stars),
        threshold_sigma=config.threshold_sigma,
        min_area_px=config.min_area_px,
        gain_e_dn=scene.camera.detector.gain_e_dn,
        saturation=saturation_dn(scene.camera.detector),
        centroid_sigma_px=config.centroid_sigma_px,
        **chosen,
    )


def algorithm_tables(scene: Scene) -> dict[str, Mapping[str, object]]:
    """The algorithms by name that a scene's tracker may use, by stage."""
    near: dict[str, Mapping[str, object]] = {}
    if isinstance(scene.light, DomeConfig):
        near = {"identifier": NEAR_IDENTIFIERS, "solver": NEAR_SOLVERS}
    return STAR_ALGORITHMS | near


def algorithm_names(scene: Scene) -> dict[str, tuple[str, ...]]:
    """All algorithms that a scene's tracker may name, by stage."""
    return {stage: tuple(table) for stage, table in algorithm_tables(scene).items()}


def require_algorithm(stage: str, name: str, algorithms: Mapping[str, object]) -> str:
    """Return the name if it is one of the algorithms, else raise InputError.

    Only the estimator has the list, and the scene package may not import it, so the name is checked here.
    """
    if name not in algorithms:
        raise InputError(f"tracker.{stage}", *unknown_name(stage, name, algorithms))
    return name
