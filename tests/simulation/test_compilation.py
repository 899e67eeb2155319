"""The tracker's compilation in a second process reaches every stage of it."""

from __future__ import annotations

import pytest

from skysim.core.paths import SCENES
from skysim.scene import loader
from skysim.simulation.compilation import synthetic_frame
from skysim.simulation.lab import build_lab, build_tracker
from skysim.tracking import factory

# Too few or too regular LEDs for an attitude.
SYMMETRIC = {"afit_test1", "afit_test2", "afit_test3"}
CODED = {"coded_spiral"}  # a frame alone does not name its LEDs
NAMES = (
    {path.stem.removesuffix("_ideal") for path in SCENES.glob("*.yaml")} - SYMMETRIC - CODED
)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(NAMES))
def test_the_synthetic_frame_is_solved(name: str) -> None:
    """A frame that is refused earlier would leave the later stages to be compiled in the first process."""
    lab = build_lab(loader.load(name))
    report = factory.solve_frame(
        build_tracker(lab.camera), synthetic_frame(lab.camera, lab.start)
    )
    assert report.attitude.status == "solved"
