"""SHEFEX-2's night-sky tests, end to end on rendered frames (Samaan & Theil 2011, sections 4 and 5).

Frames at random attitudes of the northern sky, with moonlit sky and atmospheric absorption or in space, go through
the paper's processing chain and through our default one. Varied: exposure time, rotation rate, focus.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera import background
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.papers.shefex.optics import DEFOCUS_M, answers, out_of_focus
from skysim.experiments.papers.shefex.setup import PUBLISHED, chain, line
from skysim.experiments.study import trials
from skysim.experiments.study.plan import FrameTrial
from skysim.experiments.study.setups import Setup
from skysim.results import metrics
from skysim.results.metrics import Summary, share
from skysim.scene.loader import load
from skysim.simulation import testbed
from skysim.tracking import factory

MOON_DEG = (90.0, 20.0)  # right ascension, declination
FROM_MOON_DEG = 30.0
SKY = "{kind: sky, mag_arcsec2: 20}"
MOON = "{kind: moon, ra_deg: 90, dec_deg: 20, phase_angle_deg: 0, moon_zenith_deg: 40, field_zenith_deg: 30}"
ONE = {"exposure.first": "10 ms", "exposure.frames": "1"}
AIR = {"camera.transmission": "0.595"}  # 30 % less than the scene's 0.85
MOONLESS, FULL_MOON = AIR | {"background": f"[{SKY}]"}, AIR | {"background": f"[{SKY}, {MOON}]"}
NORTH_DEG = (8.0, 90.0)  # declinations that culminate above 45 deg at Bremen
RATES, QUICK_RATES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0), (0.0, 2.0, 4.0, 5.0)
SPACE_RATES = (0.0, 2.0, 4.0, 6.0)
SIGMA, LOW_SIGMA = 5.0, 4.0
CATALOGUE = "uniform"  # "processed using the uniform Hipparcos catalog"


class Tally(NamedTuple):
    """Results of N frames, each (N,): solved correctly, solved wrongly, number of centroids, by the paper's chain.

    low : solved correctly by it with a threshold of LOW_SIGMA in place of SIGMA;  ours : by our default chain
    """

    right: Floats
    wrong: Floats
    centroids: Floats
    low: Floats
    ours: Floats

    @property
    def share(self) -> Summary:
        return share(self.right.sum(), len(self.right))

    @property
    def told(self) -> str:
        wrong = f"{int(self.wrong.sum())} of {len(self.wrong)} named wrongly"
        return f"{wrong}; our default chain {self.ours.mean():.2f}"


def shots(
    told: dict[str, str], rate_deg_s: float, count: int, seed: int
) -> Iterator[tuple[Setup, Frame, Truth]]:
    """Yield frames at random attitudes of the northern sky, not near the Moon; the same attitudes for every rate."""
    where = testbed.build_testbed(load("shefex2", ONE | told))
    ready = Setup(
        where,
        testbed.tracker(where),
        FrameTrial(kind="frames", rate_deg_s=rate_deg_s, dec_deg=NORTH_DEG),
        "",
    )
    moon, draw, done = background.direction(*MOON_DEG), 1_000_000 * seed, 0
    while done < count:
        draw += 1
        boresight = trials.attitude(ready, trials.streams(ready, draw)[0]) * where.mount.cam_from_body.inv()
        if background.apart_deg(boresight.apply([[0.0, 0.0, 1.0]]), moon)[0] < FROM_MOON_DEG:
            continue
        frame, truth, _ = trials.shot(ready, draw)
        done += 1
        yield ready, frame, truth


def tally(told: dict[str, str], rate_deg_s: float, count: int, seed: int) -> Tally:
    """Process frames with all chains."""
    rows = []
    for ready, frame, truth in shots(told, rate_deg_s, count, seed):
        theirs, lower = (
            chain(CATALOGUE, sigma, ready.lab.scene.camera.focal_px).solve(frame.image_dn)
            for sigma in (SIGMA, LOW_SIGMA)
        )
        found = theirs.cam_from_ref
        right, low = rightly(found, truth), rightly(lower.cam_from_ref, truth)
        ours = rightly(factory.solve_frame(ready.estimator, frame).attitude.cam_from_ref, truth)
        rows.append((right, found is not None and not right, len(theirs.centroids), low, ours))
    return Tally(*np.array(rows, float).T)


def rightly(found: Rotation | None, truth: Truth) -> bool:
    """Return True if a frame is solved with an error below ten arc-minutes."""
    return found is not None and not metrics.is_wrong(found, truth.cam_from_lab)


def nights(ask: Ask) -> Found:
    """Success rates at rest (35 to 50 ms, in space), against the rate, and out of focus; and the camera's optics."""
    rates, space = (QUICK_RATES, QUICK_RATES[:1]) if ask.quick else (RATES, SPACE_RATES)
    wanted: dict[str, tuple[dict[str, str], float]] = {
        **{f"ground {rate:g}": (FULL_MOON | at(50), rate) for rate in rates},
        **{f"space {rate:g}": (at(50), rate) for rate in space},
        "35 ms": (FULL_MOON | at(35), 0.0),
        "40 ms": (FULL_MOON | at(40), 0.0),
        "moonless": (MOONLESS | at(50), 0.0),
        "defocus": (FULL_MOON | at(50) | out_of_focus(DEFOCUS_M), 0.0),
        "half defocus": (FULL_MOON | at(50) | out_of_focus(DEFOCUS_M / 2), 0.0),
    }
    came: dict[str, Tally] = {}
    for key, (told, rate) in wanted.items():
        came[key] = tally(told, rate, ask.trials(150, 10), ask.seed)
        ask.watch(len(came), len(wanted))
    pictures = (
        Drawing("Frames identified against the turning rate.", partial(draw_rates, came)),
        Drawing(
            "Fig. 11: a frame of 40 ms, its centroids and those identified.", partial(draw_frame, ask.seed)
        ),
    )
    return Found(of_nights(came) | answers(ask), pictures)


def of_nights(came: dict[str, Tally]) -> dict[str, Answer]:
    """Answers from the frames to the statements of sections 4 and 5."""
    blurred, half, still = came["defocus"], came["half defocus"], came["ground 0"]
    dark = f"without the Moon {came['moonless'].share.value:.2f}"
    seen = came["40 ms"].centroids
    fewest, middle, most = np.quantile(seen, [0.025, 0.5, 0.975], method="nearest")
    working = {"35 ms": came["35 ms"], "40 ms": came["40 ms"], "50 ms": still}
    each = ", ".join(f"{one.share.value:.2f} at {name}" for name, one in working.items())
    together, lower = (
        resampled(np.mean([getattr(one, name) for one in working.values()], axis=0), np.mean)
        for name in ("right", "low")
    )
    return {
        "ground_50": Answer(still.share, f"{dark}; {still.told}"),
        "ground": Answer(together, each, Cause(f"a threshold of {LOW_SIGMA:g} sigma", lower)),
        "space": Answer(came["space 0"].share, came["space 0"].told),
        "rate_2": Answer(came["ground 2"].share, came["ground 2"].told),
        "rate_5": Answer(
            came["ground 5"].share, f"at 4 deg/s {came['ground 4'].share.value:.2f}; {came['ground 5'].told}"
        ),
        "defocus": Answer(blurred.share, f"at 0.05 mm {half.share.value:.2f}; {blurred.told}"),
        "centroids": Answer(Summary(float(middle), float(fewest), float(most), len(seen))),
    }


def at(exposure_ms: int) -> dict[str, str]:
    return {"exposure.time": f"{exposure_ms} ms"}


def draw_rates(came: dict[str, Tally], fig: Any) -> None:
    axes = fig.subplots()
    for n, (where, label) in enumerate((("ground", "ours, under air and Moon"), ("space", "ours, in space"))):
        found = {float(key.split()[1]): one for key, one in came.items() if key.startswith(where)}
        line(axes, list(found), [one.share for one in found.values()], n, f"{label}, the paper's chain")
        if n == 0:
            ours = [share(one.ours.sum(), len(one.ours)) for one in found.values()]
            line(axes, list(found), ours, 2, f"{label}, our default chain")
    axes.axvspan(0, 2, color=PUBLISHED, alpha=0.25, lw=0, label="published: mostly identified")
    axes.axvspan(4, 8, color=PUBLISHED, alpha=0.1, lw=0, label="published: rarely identified")
    axes.set(xlabel="turning rate (deg/s)", ylabel="frames identified", ylim=(0, 1.03), xlim=(-0.1, 8.1))
    axes.legend(fontsize=8)


def draw_frame(seed: int, fig: Any) -> None:
    """Draw the first frame in which the paper's chain identifies at least eight stars, or the last of forty."""
    axes = fig.subplots()
    for ready, frame, _ in shots(FULL_MOON | at(40), 0.0, 40, seed):
        found = chain(CATALOGUE, SIGMA, ready.lab.scene.camera.focal_px).solve(frame.image_dn)
        if len(found.observed) >= 8:
            break
    low, high = np.percentile(frame.image_dn, [50, 99.95])
    axes.imshow(frame.image_dn, cmap="gray_r", vmin=low, vmax=high, interpolation="none")
    xy_px = found.centroids.xy_px
    axes.scatter(*xy_px.T, s=130, facecolors="none", edgecolors="blue", label=f"{len(xy_px)} centroids")
    named = xy_px[found.observed]
    axes.scatter(*named.T, s=45, facecolors="none", edgecolors="red", label=f"{len(named)} identified")
    axes.set(xlabel="x (px)", ylabel="y (px)")
    axes.grid(visible=False)
    fig.legend(*axes.get_legend_handles_labels(), loc="outside right upper")
