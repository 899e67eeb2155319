"""Make the pictures of the pages from the output of `make demo` and from new frames. `make pictures` runs it."""

from __future__ import annotations

import re
from pathlib import Path

import cv2

from skysim.core import files
from skysim.dynamics.multibody.scene_picture import picture
from skysim.results import plots, telemetry_report
from skysim.scene import loader
from skysim.simulation.flight import simulate_motion

IMAGES = Path(__file__).parents[1] / "images"
OUT = Path(__file__).parents[2] / "out"
RATES_DEG_S = (0, 1, 2, 4, 8)
WINDOW = (slice(196, 296), slice(279, 379))  # the middle hundred pixels


def frame(rate_deg_s: float):  # type: ignore[no-untyped-def]
    """One 50 ms exposure of the Pleiades, rotating about the image's vertical axis."""
    overrides = {
        "motion.start": "{ra_deg: 56.87, dec_deg: 24.1, roll_deg: 0}",
        "motion.rate_deg_s": f"[0, {rate_deg_s}, 0]",
        "exposure": "{time: 50 ms, rate_hz: 10, frames: 1, first: 0 s}",
    }
    loaded = loader.load("shefex2", overrides)
    return simulate_motion(loaded).render(0)


def main() -> None:
    for name, scene_name in (("dome", "afit_simsat"), ("sky", "shefex2")):
        annotated = cv2.imread(str(OUT / scene_name / "annotated.png"))
        width = 1200
        size = (width, round(width * annotated.shape[0] / annotated.shape[1]))
        files.write_image(
            IMAGES / f"{name}.jpg", cv2.resize(annotated, size, interpolation=cv2.INTER_AREA)
        )
    flight = simulate_motion(loader.load("simsat_slew"))
    rendered = picture(flight.lab.export_mjcf(), flight.telemetry().joints[700])
    files.write_image(IMAGES / "lab.jpg", rendered[:, :, ::-1])
    bumped = simulate_motion(loader.load("simsat_bump"))
    (IMAGES / "bump.png").write_bytes(telemetry_report.figure(bumped.telemetry()))
    exposures = [frame(rate) for rate in RATES_DEG_S]
    captions = [
        f"{rate} deg/s, {truth.sources.streak_px.max():.1f} px"
        for rate, (_, truth) in zip(RATES_DEG_S, exposures, strict=True)
    ]
    sheet = plots.contact_sheet(
        [image.image_dn[WINDOW] for image, _ in exposures], captions, scale=3
    )
    files.write_image(IMAGES / "smear.png", sheet)
    screenshots()


def screenshots() -> None:
    """Screenshots of the GUI: a sky scene, and the playback of a slew under the dome."""
    from playwright.sync_api import sync_playwright

    from benchmarks.lab import FLAGS, chromium, served

    with served("shefex2") as server, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium(), args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1440, "height": 860})
        page.set_default_timeout(180_000)
        page.goto(server.url)
        page.locator(".lab-card [data-state=good]").wait_for()
        page.wait_for_timeout(3000)  # the first frame clears earlier clicks
        page.get_by_role("tab", name="Lights").click()
        bellatrix = page.locator("tr", has_text="Bellatrix")
        bellatrix.wait_for()
        heads = page.locator(".lab-lights th").all_text_contents()
        box, (left, top, scale) = frame_placement(page)
        x, y = (
            float(bellatrix.locator("td").nth(heads.index(name)).inner_text())
            for name in ("x, px", "y, px")
        )
        page.mouse.click(
            box["x"] + left + (x + 0.5) * scale, box["y"] + top + (y + 0.5) * scale
        )
        page.wait_for_timeout(3000)
        page.screenshot(path=IMAGES / "lab_page.jpg", quality=85)
        page.get_by_role("combobox", name="Scene").click()
        page.get_by_role("option", name="simsat_slew").click()
        page.get_by_text("yaw, deg").wait_for()  # of a dome
        page.get_by_role("tab", name="Run").click()
        page.get_by_role("button", name="Simulate").click()
        page.get_by_text(re.compile(r"^2\d\.\d\d s +\d+/34$")).wait_for()
        page.wait_for_timeout(300)
        page.screenshot(path=IMAGES / "lab_run.jpg", quality=85)
        browser.close()


def frame_placement(page):  # type: ignore[no-untyped-def]
    """Box of the frame's canvas on the page, and the frame's left and top edge and scale in it."""
    canvas = page.locator(".lab-frame canvas")
    return canvas.bounding_box(), [
        float(value) for value in canvas.get_attribute("data-placement").split()
    ]


if __name__ == "__main__":
    main()
