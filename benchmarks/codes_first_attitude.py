"""Time to the first attitude under blinking LEDs: by the vehicle's rate, the length of the code and the number of LEDs.

From the sequences of `codes_attitudes`. The figure of docs/explanation/coded_light.md is drawn in out/benchmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.codes_attitudes import Bench
from benchmarks.timing import figure as figure_row
from skysim.core.files import make_folder
from skysim.core.paths import ROOT

SEQUENCES = 60
CODES = {
    "Gray, 9 bits": "{kind: gray}",
    "Hamming, 14": "{kind: hamming}",
    "BCH, 19": "{kind: bch, distance: 5}",
    "BCH, 24": "{kind: bch, distance: 7}",
    "Gold, 31": "{kind: gold}",
}
RATES_DEG_S = (0.0, 5.0, 10.0)
COUNTS = (200, 400, 800)
# where the other one is varied
COUNT = 400
RATE_DEG_S = 5.0
IMAGE = ROOT / "out/benchmarks/first_attitude.svg"


@dataclass(frozen=True)
class Result:
    """Times to the first attitude, s: median and 95 %; and the part of the sequences with one in a code's length."""

    code: str
    leds: int
    rate_deg_s: float
    bits: int
    median_s: float
    most_s: float
    found: float


def result(code: str, leds: int, rate_deg_s: float, sequences: int) -> Result:
    """Some sequences of a code's length, each from a random attitude; a missing attitude is late by all of it."""
    bench = Bench({"light.led.code": CODES[code], "light.layout.count": str(leds)})
    first = np.array([bench.sequence(rate_deg_s, seed).first for seed in range(sequences)])
    bits = bench.tracker.code.bits
    frame_s = 1 / bench.lab.scene.exposure.rate_hz
    late_s = np.where(first > 0, first, np.inf) * frame_s
    median_s, most_s = np.quantile(late_s, [0.5, 0.95], method="higher")
    return Result(
        code,
        leds,
        rate_deg_s,
        bits,
        float(median_s),
        float(most_s),
        float(np.mean(first > 0)),
    )


def results(sequences: int) -> list[Result]:
    """All codes at all rates with COUNT LEDs, and with other numbers of LEDs at RATE_DEG_S."""
    cases = [(COUNT, rate_deg_s) for rate_deg_s in RATES_DEG_S]
    cases += [(count, RATE_DEG_S) for count in COUNTS if count != COUNT]
    return [result(code, *case, sequences) for code in CODES for case in cases]


def draw(every: list[Result], path: Path) -> None:
    """Medians, with bars to 95 %, over the length of the code: by rate, and by the number of LEDs."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams.update({"svg.hashsalt": "skysim", "svg.fonttype": "none", "font.size": 11})
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.6), sharey=True, layout="constrained")
    by_rate = {
        f"{rate:g} deg/s": [
            one for one in every if (one.leds, one.rate_deg_s) == (COUNT, rate)
        ]
        for rate in RATES_DEG_S
    }
    by_count = {
        f"{leds} LEDs": [
            one for one in every if (one.leds, one.rate_deg_s) == (leds, RATE_DEG_S)
        ]
        for leds in COUNTS
    }
    for panel, groups, title in zip(
        panels, (by_rate, by_count), (f"{COUNT} LEDs", f"{RATE_DEG_S:g} deg/s"), strict=True
    ):
        for shift, (label, group) in zip((-0.35, 0, 0.35), groups.items(), strict=True):
            bits = np.array([one.bits for one in group]) + shift
            median_ms = 1e3 * np.array([one.median_s for one in group])
            above_ms = (
                1e3 * np.array([min(one.most_s, one.bits / 50) for one in group]) - median_ms
            )
            panel.errorbar(
                bits, median_ms, [0 * above_ms, above_ms], fmt="o", capsize=3, label=label
            )
        panel.plot(
            [0, 32],
            [0, 640],
            color="#999999",
            linewidth=1,
            linestyle=":",
            label="whole word at 50 Hz",
        )
        panel.set(xlabel="bits of the code", title=title, xlim=(7, 33), ylim=(0, None))
        panel.legend(fontsize=9)
    panels[0].set_ylabel("time to first attitude, ms")
    figure.savefig(path, metadata={"Date": None})


def measure(count: int = SEQUENCES) -> list[dict[str, Any]]:
    """Median and 95 % of the time to the first attitude of all cases, `count` sequences each; draws IMAGE."""
    every = results(count)
    make_folder(IMAGE.parent)
    draw(every, IMAGE)
    rows = []
    for one in every:
        name = f"{one.code}, {one.leds} LEDs, {one.rate_deg_s:g} deg/s"
        rows += [
            figure_row(f"{name}: first attitude, median", 1e3 * one.median_s, "ms"),
            figure_row(f"{name}: first attitude, 95 %", 1e3 * one.most_s, "ms"),
            figure_row(f"{name}: found within the code", 100 * one.found, "%"),
        ]
    return rows
