"""The README's pictures, from what `make demo` left in out/ and from frames of its own. `make pictures` runs it."""

from __future__ import annotations

from pathlib import Path

import cv2

from skysim import flightlog, io, report, scene, simulate
from skysim.world.picture import picture

DOCS = Path(__file__).parent
OUT = DOCS.parent / "out"
RATES_DEG_S = (0, 1, 2, 4, 8)
WINDOW = (slice(196, 296), slice(279, 379))  # the middle hundred pixels


def frame(rate_deg_s: float):  # type: ignore[no-untyped-def]
    """One 50 ms exposure whose middle looks at the Pleiades, turning about the image's vertical."""
    overrides = {
        "motion.start": "{ra_deg: 56.87, dec_deg: 24.1, roll_deg: 0}",
        "motion.rate_deg_s": f"[0, {rate_deg_s}, 0]",
        "exposure": "{time: 50 ms, rate_hz: 10, frames: 1, first: 0 s}",
    }
    loaded = scene.load("shefex2", overrides)
    return simulate.shoot(simulate.prepare(loaded), 0)


def main() -> None:
    for name, scene_name in (("dome", "afit_simsat"), ("sky", "shefex2")):
        annotated = cv2.imread(str(OUT / scene_name / "annotated.png"))
        width = 1200
        size = (width, round(width * annotated.shape[0] / annotated.shape[1]))
        io.write_image(DOCS / f"{name}.jpg", cv2.resize(annotated, size, interpolation=cv2.INTER_AREA))
    lab = simulate.prepare(scene.load("simsat_slew"))
    drawn = picture(simulate.staged(lab), lab.log.joints[700])
    io.write_image(DOCS / "lab.jpg", drawn[:, :, ::-1])
    (DOCS / "bump.png").write_bytes(flightlog.figure(simulate.prepare(scene.load("simsat_bump")).log))
    shots = [frame(rate) for rate in RATES_DEG_S]
    captions = [
        f"{rate} deg/s, {truth.seen.streak_px.max():.1f} px"
        for rate, (_, truth) in zip(RATES_DEG_S, shots, strict=True)
    ]
    sheet = report.contact_sheet([shot.image_dn[WINDOW] for shot, _ in shots], captions, scale=3)
    io.write_image(DOCS / "smear.png", sheet)


if __name__ == "__main__":
    main()
