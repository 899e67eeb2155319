"""A dome's map beside a scene: what differs is forecast and warned of, and what comes is what was forecast."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import skysim
from skysim.core.errors import InputError
from skysim.simulation.checks import detection, expected_error, findings
from skysim.simulation.checks.plan_check import check
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import onboard_model
from skysim.tracking.dome_map_file import DomeMap, write_dome_map

SCENE = "afit_simsat_ideal"
AT_REST = {"motion.control": None, "motion.maneuver": [], "exposure.frames": 1}
SIGMA_M = 1e-5
ASIDE_M = np.array([0.005, 0, 0])
UP = np.array([0, 0, 1])


def mapped(folder: Path, change: Callable[[DomeMap], DomeMap] = lambda one: one) -> str:
    """The file of a map that has the scene's LEDs, lever and lens, to 0.01 mm, and then a change."""
    lab = build_lab(skysim.load_scene(SCENE))
    lens = onboard_model.calibration(lab.scene.camera)
    leds = lab.camera.sources
    exact = DomeMap(
        leds.id,
        leds.place[:, :3],
        np.full(len(leds), SIGMA_M),
        lab.camera.mount.camera_body_m,
        SIGMA_M,
        (lens.width_px, lens.height_px),
        lens.focal_px,
        1e-3,
        lens.center_px,
        (0.0, 0.0),
        lens.distortion,
        (0.0,) * 5,
    )
    path = folder / "leds.ecsv"
    write_dome_map(path, change(exact))
    return str(path)


def lab_with(path: str) -> Lab:
    return build_lab(skysim.load_scene(SCENE, AT_REST | {"tracker.map": path}))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda one: one, ""),
        (lambda one: replace(one, camera_body_m=one.camera_body_m + 1e-5), ""),
        (
            lambda one: replace(one, camera_body_m=one.camera_body_m + ASIDE_M),
            "its lever is 5 mm from the scene's",
        ),
        (
            lambda one: replace(one, focal_px=1.01 * one.focal_px),
            "its focal length differs by +1 %",
        ),
        (
            lambda one: replace(one, distortion=(0.01, 0.0, 0.0, 0.0, 0.0)),
            "its distortion is not the scene's",
        ),
        (
            lambda one: replace(one, center_px=(one.center_px[0] + 3, one.center_px[1])),
            "its principal point is not the scene's",
        ),
        (
            lambda one: replace(one, position_m=one.position_m + 3e-3 * UP),
            "LEDs are up to 3 mm from the scene's",
        ),
    ],
)
def test_a_map_of_other_hardware_is_named_by_what_differs(
    tmp_path: Path, change: Callable[[DomeMap], DomeMap], says: str
) -> None:
    context = detection.context_of(lab_with(mapped(tmp_path, change)))
    faults = "; ".join(context.beliefs.faults)
    assert bool(faults) == bool(says)
    assert says in faults


@pytest.mark.slow
def test_a_wrong_lever_is_forecast_by_hand_and_comes(tmp_path: Path) -> None:
    """A camera that is d beside its place in the map, under a dome of radius R about the bearing, errs by d / R."""

    def aside(one: DomeMap) -> DomeMap:
        return replace(one, camera_body_m=one.camera_body_m + ASIDE_M)

    path = mapped(tmp_path, aside)
    by_hand = math.degrees(0.005 / np.linalg.norm([0, 0, 48 * 0.0254])) * 3600
    found = check(lab_with(path))
    (fact,) = [one for one in found.facts if one.name == "expected error"]
    expected = fact.values["frames"]["cross_arcsec"]
    warning = "tracker.map: made of other hardware: its lever is 5 mm"
    assert sum(line.startswith(warning) for line in found.findings) == 1
    assert expected == pytest.approx(by_hand, rel=0.1)
    (shot,) = skysim.simulate(
        skysim.load_scene(
            SCENE, AT_REST | {"tracker.map": path, "tracker.centroid_sigma_px": 2}
        )
    )
    assert shot.row.cross_arcsec == pytest.approx(expected, rel=0.05)


def test_a_map_of_another_dome_is_refused_in_one_line(tmp_path: Path) -> None:
    def shuffled(one: DomeMap) -> DomeMap:
        return replace(one, position_m=np.roll(one.position_m, 7, axis=0))

    with pytest.raises(InputError, match=r"^tracker.map: .*: of another dome: \d+ of its"):
        detection.context_of(lab_with(mapped(tmp_path, shuffled)))


def test_every_cause_of_misplaced_images_has_its_advice() -> None:
    causes = {*expected_error.UNKNOWN_TO_TRACKER, *expected_error.OUTSIDE_OF_GATE}
    assert set(findings.ADVICE) == causes
    assert causes <= set(expected_error.CAUSES)
