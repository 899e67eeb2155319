"""Time of the tracker's stages on another computer, such as SHEFEX-2's of 650 MHz (Samaan & Theil 2011, section 2.2).

    time = measured time x clock here / clock there x cycles_factor

The first two factors are the cycles that were counted here; cycles_factor is that of the other processor's cycles for
the same work (fewer instructions at once, smaller caches, another language). Times differ from run to run.
"""

import functools
import math
import re
from collections.abc import Mapping
from pathlib import Path

from skysim.core.errors import InputError
from skysim.scene.sections.tracker import ComputerConfig

STAGES = ("detect", "centroid", "identify", "solve")
CPUINFO = Path("/proc/cpuinfo")


@functools.cache
def fastest_mhz() -> float:
    """The fastest clock of this machine's processors. Raises InputError where Linux does not state it."""
    text = CPUINFO.read_text(encoding="utf-8") if CPUINFO.is_file() else ""
    clocks = re.findall(r"cpu MHz\s*: ([\d.]+)", text)
    if not clocks:
        raise InputError(
            "tracker.computer.host_clock_mhz",
            f"no clock in {CPUINFO}",
            "this machine's clock",
        )
    return max(map(float, clocks))


def on_computer(config: ComputerConfig, measured: Mapping[str, float]) -> dict[str, float]:
    """Times of the tracker's stages on that computer, in the unit of those measured here."""
    scale = (config.host_clock_mhz or fastest_mhz()) / config.clock_mhz * config.cycles_factor
    return {stage: scale * measured[stage] for stage in STAGES if stage in measured}


def total(config: ComputerConfig | None, measured: Mapping[str, float]) -> float:
    """Sum of these times; NaN without a computer."""
    return sum(on_computer(config, measured).values()) if config else math.nan


def computer_text(config: ComputerConfig, stages_ms: Mapping[str, float]) -> str:
    """The sentence of a report on these times, with the clocks and where they are from."""
    stages = ", ".join(
        f"{stage} {ms:.2f}" for stage, ms in on_computer(config, stages_ms).items()
    )
    origin = "host_clock_mhz" if config.host_clock_mhz else CPUINFO
    return (
        f"On a computer of {config.clock_mhz:g} MHz: {stages}; {total(config, stages_ms):.2f} ms together"
        f" (measured at {(config.host_clock_mhz or fastest_mhz()):g} MHz by {origin},"
        f" cycles x {config.cycles_factor:g})"
    )
