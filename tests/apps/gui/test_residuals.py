"""Residuals of the identified lights: their vectors, arrows over the frame, and means of each light over a flight."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    come,
    differs,
    open_scene,
    opened,
    panel,
    picture,
    pictured,
    simulate,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.messages import Residual
from skysim.apps.gui.page import residuals
from skysim.apps.gui.worker.playback import Playback
from skysim.apps.gui.worker.workbench import Workbench

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


@pytest.mark.parametrize("name", ["shefex2", "afit_simsat"])
def test_the_arrows_have_the_rms_that_the_tracker_reports(name: str) -> None:
    """`rms_px` is along one axis, so the vectors' mean square is twice its square."""
    result = Workbench.open(name, {}).render_at_rest(solve=True).result
    assert result is not None
    vectors_px = np.array([one.residual_px for one in result.detections if one.id >= 0])
    assert len(vectors_px) == result.row.matched
    np.testing.assert_allclose(
        np.mean(np.sum(vectors_px**2, axis=1)), 2 * result.row.rms_px**2, rtol=1e-6
    )


@pytest.mark.slow
def test_the_mean_residual_of_an_led_points_to_its_true_place() -> None:
    """The place errors of a dome's map, seen from the camera, less what the attitude takes of them."""
    bench = Workbench.open("afit_simsat", {"exposure.frames": "12"})
    playing = Playback(bench)
    found = []
    while not (step := playing.advance(1.0)).is_done:
        found += step.residuals
    found += step.residuals
    ids, _, means_px, _ = residuals.by_light(found)
    assert np.all(np.diff(np.linalg.norm(means_px, axis=1)) <= 0)
    sources = bench.lab.camera.sources
    true_m = dict(zip(sources.id.tolist(), sources.place[:, :3], strict=True))
    leds = bench.estimator.leds  # type: ignore[union-attr]
    map_m = dict(zip(leds.id.tolist(), leds.position_m, strict=True))
    cosines = []
    for id, mean_px in zip(ids.tolist()[:12], means_px, strict=False):
        error_m = true_m[id] - map_m[id]
        cosines.append(error_m @ mean_px / np.linalg.norm(error_m) / np.linalg.norm(mean_px))
    assert np.median(cosines) > 0.7


def test_mean_and_scatter_of_a_light_are_those_of_its_draws() -> None:
    rng = np.random.default_rng(2)
    bias_px = {1: [0.5, 0.0, 0.0], 2: [0.0, 0.0, 0.0], 3: [0.0, -3.0, 4.0]}
    draws = {id: mean + 0.1 * rng.normal(size=(400, 3)) for id, mean in bias_px.items()}
    found = [
        Residual(n, id, 0.0, tuple(vector))
        for id, vectors in draws.items()
        for n, vector in enumerate(vectors)
    ] + [Residual(0.0, 7, 0.0, (0.0, 0.0, 1.0))]
    ids, frames, mean_px, scatter_px = residuals.by_light(found)
    assert ids.tolist() == [3, 7, 1, 2]
    assert frames.tolist() == [400, 1, 400, 400]
    np.testing.assert_allclose(mean_px[0], [0.0, -3.0, 4.0], rtol=0, atol=0.02)
    # Three axes, each with the draws' standard deviation.
    np.testing.assert_allclose(scatter_px[[0, 2, 3]], 0.1 * 3**0.5, rtol=0.1)
    assert np.isnan(scatter_px[1])
    assert len(residuals.by_light(())[0]) == 0


SCALE_JS = """async ([lengths, wanted]) => {
  const { arrowScale } = await import("skysim-views/marks.js");
  return arrowScale(lengths, wanted);
}"""


@pytest.mark.browser
@in_browser
def test_a_wrong_match_neither_scales_nor_covers_the_other_arrows(
    browser: Any, server: Server
) -> None:
    with opened(browser, server.login, NARROW) as page:
        alone = page.evaluate(SCALE_JS, [[0.05] * 9, 25])
        both = page.evaluate(SCALE_JS, [[0.05] * 9 + [300], 25])
        assert alone["factor"] == both["factor"] == 500
        assert both["longest"] == pytest.approx(0.4)
        assert alone["text"] == "arrows × 500, median 0.0500 px of 9"
        assert both["text"].endswith("of 10; 1 shortened, up to 300 px")
        assert page.evaluate(SCALE_JS, [[0.013], 25])["factor"] == 2000
        assert page.evaluate(SCALE_JS, [[], 25])["text"] == ""


@pytest.mark.browser
@in_browser
def test_arrows_are_drawn_over_the_frame_and_over_the_dome(
    browser: Any,
    server: Server,
) -> None:
    with opened(browser, server.login, NARROW) as page:
        open_scene(page, "afit_simsat")
        canvas = page.locator(".lab-frame > canvas")
        box = {name: int(value) for name, value in canvas.bounding_box().items()}
        corners = box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]
        before = picture(page)
        page.get_by_role("checkbox", name="residuals", exact=True).click()
        assert come(lambda: "arrows × " in str(canvas.get_attribute("data-arrows")))
        text = str(canvas.get_attribute("data-arrows"))
        assert re.match(r"arrows × [125]0*, median [\d.]+ px of \d+", text)
        assert come(lambda: differs(page, before, corners))
        pictured(page, "residual_arrows")
        simulate(page, 12)
        page.get_by_text(re.compile(r"\d+ of 12 frames solved")).first.wait_for()
        panel(page, "Run")
        rows = page.locator(".lab-run .lab-lights tbody tr")
        assert come(lambda: rows.count() > 10)
        means = [float(row.locator("td").nth(2).inner_text()) for row in rows.all()]
        assert means == sorted(means, reverse=True)
        page.get_by_label("residuals in 3-D").click()
        dome = page.locator(".lab-space canvas").first
        assert come(lambda: dome.get_attribute("data-arrows") == str(len(means)))
        page.get_by_text(re.compile("^arrows × ")).wait_for()
        page.get_by_role("button", name="bearing", exact=True).click()
        page.wait_for_timeout(1500)
        pictured(page, "residuals_over_the_dome")
        # The next flight has its own lights.
        panel(page, "Run")
        page.get_by_role("button", name="Simulate").click()
        page.get_by_text(re.compile(r"\d+ of 12 frames solved")).first.wait_for()
