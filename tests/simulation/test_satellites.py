"""Satellites in a scene: drawn as streaks, listed in the truth, and each rejected by the tracker as one object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from scipy.spatial import cKDTree

from skysim.core.errors import InputError
from skysim.core.types import SourceTruth
from skysim.results.files.recording import write_frame
from skysim.scene import loader
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.sources.satellites import ID_BASE
from skysim.tracking.factory import solve_frame

FRAMES = 6


def lab_of(**keys: str) -> Lab:
    overrides = {key.replace("__", "."): value for key, value in keys.items()}
    return build_lab(loader.load("shefex2", {"exposure.frames": str(FRAMES), **overrides}))


def streaks(sources: SourceTruth) -> np.ndarray:
    return sources.id >= ID_BASE


@pytest.mark.slow
def test_streaks_are_as_long_and_as_bright_as_their_satellites() -> None:
    """Length: rate times exposure, by the scale at the streak. Light: that of a star of the magnitude and color."""
    random = "{per_field: 60, seed: 3, rate_deg_s: [0.5, 3], v_mag: [2, 2]}"
    lab = lab_of(
        light__satellites__random=random,
        camera__detector__noise="false",
        light__limit_mag="0",
    )
    _, truth = render_at_rest(lab.camera, lab.start, 0)
    rows = truth.sources
    light = {satellite.id: satellite for satellite in truth.satellites}
    camera = lab.scene.camera
    inside = (np.abs(rows.xy_px - np.array(camera.center_px)) < 100).all(axis=1) & streaks(
        rows
    )
    assert np.count_nonzero(inside) >= 2
    for n in np.flatnonzero(inside):
        expected_px = (
            np.radians(light[rows.id[n]].rate_deg_s)
            * lab.scene.exposure.time_s
            * camera.focal_px
        )
        assert rows.streak_px[n] == pytest.approx(expected_px, rel=0.03)
    assert np.ptp(rows.electrons[inside]) < 0.02 * rows.electrons[inside].max()


def test_a_satellite_has_its_row_and_its_details_in_the_header(tmp_path: Path) -> None:
    lab = lab_of(light__satellites__random="{per_field: 6, seed: 3, v_mag: [1, 3]}")
    frame, truth = render_at_rest(lab.camera, lab.start, 0)
    write_frame(tmp_path, frame, truth, lab.scene)
    table = Table.read(tmp_path / "frame_0000.ecsv")
    assert truth.satellites
    assert [entry["id"] for entry in table.meta["satellites"]] == table["id"][
        table["id"] >= ID_BASE
    ].tolist()
    assert set(table.meta["satellites"][0]) >= {
        "name",
        "v_mag",
        "rate_deg_s",
        "range_km",
        "sunlit",
    }


def test_a_file_requires_a_place_on_the_ground_or_in_orbit(tmp_path: Path) -> None:
    path = tmp_path / "one.tle"
    path.write_text("x", encoding="utf-8")
    with pytest.raises(
        InputError, match=r"light.satellites.file: requires the section orbit"
    ):
        loader.load("shefex2", {"light.satellites.file": str(path)})


@pytest.mark.slow
@pytest.mark.parametrize("v_mag", [2.0, 4.0, 4.5, 5.0, 6.0])
def test_a_long_streak_is_rejected_as_one_object(v_mag: float) -> None:
    """Also at 4.5, where its light is near the threshold and the streak breaks into pieces, up to nine a streak."""
    random = f"{{per_field: 3, seed: 5, v_mag: [{v_mag}, {v_mag}], rate_deg_s: [15, 20]}}"
    keys = {
        "exposure__time": "999 ms",
        "exposure__rate_hz": "1",
        "tracker__brightest": "1000",
    }
    false = []
    streaked = 0
    for settings in ({}, {"light__satellites__random": random}):
        lab = lab_of(**keys, **settings)
        tracker = build_tracker(lab.camera)
        counts = []
        for index in range(FRAMES):
            frame, truth = render_at_rest(lab.camera, lab.start, index)
            report = solve_frame(tracker, frame)
            assert report.attitude.status == "solved"
            stars = truth.sources.flux_xy_px[~streaks(truth.sources)]
            counts.append(
                np.count_nonzero(cKDTree(stars).query(report.centroids.xy_px)[0] > 3)
            )
            streaked += np.count_nonzero(streaks(truth.sources))
        false.append(sum(counts))
    assert streaked > 10
    assert false[1] - false[0] < 0.6 * streaked
