"""Each document's own tools on its own scenes: solved rightly, or refused with the setting that would help."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import NamedTuple

import pytest

from skysim.core.types import Frame, Truth
from skysim.results import metrics
from skysim.results.run_report import HELP
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from skysim.simulation.lab import build_lab, build_tracker
from skysim.tracking.factory import solve_frame

pytestmark = pytest.mark.slow  # every identifier is compiled

OWN_RULE = ("saa", "shefex", "master_star", "fialho_1", "fialho_2", "fialho_3", "fialho_4")
SETTINGS = (
    "brightest",
    "acceptance",
    "centroid_sigma_px",
    "threshold_sigma",
    "camera's offset",
    "set identifier",
)


class Document(NamedTuple):
    """A document's scenes and its algorithms of each stage; settings that go with them."""

    scenes: tuple[str, ...]
    detectors: tuple[str, ...]
    identifiers: tuple[str, ...]
    solvers: tuple[str, ...]
    settings: tuple[str, ...] = ("tracker.centroider=cog",)


TRIANGLES = ("planar_triangle", "spherical_triangle")  # thesis 2.4.1; NPS compared them too
DOCUMENTS = {
    "AFIT": Document(
        ("afit_test1", "afit_test2", "afit_test3", "afit_simsat"),
        ("thesis",),
        ("saa", *TRIANGLES),
        ("thesis",),
    ),
    "NPS": Document(("nps_tas2",), ("local",), ("master_star", *TRIANGLES), ("tappe",)),
    "PTASE": Document(
        ("ptase_2003",),
        ("components",),
        ("fialho_1", "fialho_2", "fialho_3", "fialho_4"),
        ("quest",),
        ("tracker.centroider=cog", "tracker.brightest=12"),
    ),
    "SHEFEX-2": Document(
        ("shefex2",),
        ("sequential", "maximum"),
        ("shefex",),
        ("esoq2",),
        ("tracker.centroider=cog", "tracker.brightest=15"),
    ),
}
# Frames that may be refused: nine equal LEDs in a lattice, one pair, five LEDs that are too few to be beyond chance,
# the whole catalog's lists without magnitudes.
REFUSED = {
    ("afit_test1", "saa", "evidence"),
    ("afit_test1", "saa", "thesis"),
    ("afit_test3", "saa", "evidence"),
    ("ptase_2003", "fialho_1", "evidence"),
    ("ptase_2003", "fialho_1", "thesis"),
    *(
        ("afit_test2", name, rule)
        for name in ("saa", *TRIANGLES)
        for rule in ("evidence", "thesis")
    ),
}


def pairs() -> list[tuple[str, ...]]:
    """Every pair of a document's tools and scene, with both rules where the document has its own."""
    rows = []
    for document in DOCUMENTS.values():
        stages = document.scenes, document.detectors, document.identifiers, document.solvers
        for scene, detector, identifier, solver in product(*stages):
            rules = ("evidence", "thesis") if identifier in OWN_RULE else ("evidence",)
            for rule in rules:
                rows.append((scene, detector, identifier, solver, rule, *document.settings))
    return rows


@cache
def exposures(scene: str) -> list[tuple[Frame, Truth]]:
    """The first two frames of a scene and their truth."""
    with open_flight(loader.load(scene, {"exposure.frames": "2"})) as flight:
        return [(shot.frame, shot.truth) for shot in flight.shots()]


@pytest.mark.parametrize("tools", pairs(), ids=" ".join)
def test_a_document_s_tools_solve_its_scene_or_say_what_to_set(
    tools: tuple[str, ...],
) -> None:
    name, detector, identifier, solver, rule, *settings = tools
    changed = dict(setting.split("=") for setting in settings) | {
        "tracker.detector": detector,
        "tracker.identifier": identifier,
        "tracker.solver": solver,
    }
    if identifier in OWN_RULE:
        changed["tracker.acceptance"] = rule
    tracker = build_tracker(build_lab(loader.load(name, changed)).camera)
    for frame, truth in exposures(name):
        answer = solve_frame(tracker, frame).attitude
        if answer.cam_from_ref is None:
            assert (name, identifier, rule) in REFUSED
            assert any(
                setting in HELP.get(answer.status, answer.status) for setting in SETTINGS
            )
            continue
        error_rad = (answer.cam_from_ref * truth.cam_from_lab.inv()).magnitude()
        nees = metrics.normalized_error_squared(
            answer.cam_from_ref, truth.cam_from_lab, answer.covariance_rad2
        )
        assert not metrics.is_wrong(error_rad, nees)
        # A match accepted by the paper's rule says that it was not tested against chance.
        assert answer.match is not None
        assert (answer.match.log10_chance <= -5) == (rule == "evidence")


def test_a_black_level_above_the_thesis_s_threshold_is_named() -> None:
    level = {"camera.detector.offset_dn": "42", "exposure.frames": "1"}
    scene = loader.load("afit_test3", level | {"tracker.detector": "thesis"})
    with open_flight(scene) as flight:
        (shot,) = flight.shots()
    assert "black level of 42 is above the threshold of 4 %" in shot.report.attitude.status
    assert "offset" in shot.report.attitude.status
