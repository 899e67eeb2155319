"""Lights: a new kind is one file with its schema; the forecast counts drawn lights and names occluders."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
from pydantic import Field

from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.core.types import Sources
from skysim.core.units import Intensity, Length, Time
from skysim.scene import loader
from skysim.scene.sections import light as schema
from skysim.scene.sections.light import LightConfig
from skysim.simulation.checks import check
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.flight import open_flight
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights import registry
from skysim.simulation.lights.light import Exposure, Light, LightPlan, Lit, Obstacle, Occluder
from skysim.simulation.lights.registry import register
from skysim.sources.photometry import led_strength_e_s_sr

# A light in one file, with its schema: the lighthouse. Nothing else of skysim knows of it.

LAMP_ID = 3_000_000_000


class LighthouseConfig(LightConfig):
    """One lamp that shines down and blinks.

    lit : on-time in every period, from the scene's start
    """

    kind: Literal["lighthouse"]
    place_m: tuple[Length, Length, Length]
    intensity_cd: Annotated[Intensity, Field(gt=0)]
    period_s: Annotated[Time, Field(gt=0)]
    lit_s: Annotated[Time, Field(gt=0)]


@dataclasses.dataclass(frozen=True)
class Lighthouse(Light):
    """The lamp, while it is lit."""

    config: LighthouseConfig
    lamp: Sources

    def during(self, exposure: Exposure) -> Lit:
        is_lit = exposure.t_s % self.config.period_s < self.config.lit_s
        return Lit("lighthouse", points=self.lamp if is_lit else None)


def build_lighthouse(config: LighthouseConfig, plan: LightPlan) -> Lighthouse:
    one = np.ones(1)
    zero = np.zeros(1)
    strength = np.atleast_1d(led_strength_e_s_sr(config.intensity_cd, "white", plan.band))
    place = np.array([[*config.place_m, 1.0]])
    down = np.array([[0.0, 0.0, -1.0]])
    ids = np.array([LAMP_ID])
    clock = np.zeros(1, np.int64)
    return Lighthouse(
        config,
        Sources(ids, place, down, zero, strength, one, zero, one, clock, np.full(1, np.nan)),
    )


# A second one, which hides.


class CurtainConfig(LightConfig):
    """A curtain at a place along the lab's x."""

    kind: Literal["curtain"]
    beyond_m: Length


@dataclasses.dataclass(frozen=True)
class Curtain(Obstacle):
    """Hide sources beyond it."""

    beyond_m: float

    def during(self, exposure: Exposure) -> Lit:
        return Lit(
            "the curtain",
            hides=Occluder("the curtain", lambda place: place[:, 0] > self.beyond_m),
        )


# The tests.

LAMP = "{kind: lighthouse, place: [0 m, 0 m, 1 m], intensity: 2 mcd, period: 2 s, lit: 1 s}"
LEVEL = {
    "exposure.frames": "4",
    "exposure.rate_hz": "1",
    "motion.control": "none",
    "motion.maneuver": "[]",
}


@pytest.fixture(autouse=True)
def kinds() -> Iterator[None]:
    """Adds both kinds for a test."""
    register(LighthouseConfig, build_lighthouse)
    register(CurtainConfig, lambda config, plan: Curtain(config.beyond_m))
    yield
    for kind in ("lighthouse", "curtain"):
        del schema.CONFIGS[kind], registry.KINDS[kind]


def lab_with(lamp: str, **keys: str) -> Lab:
    given = {key.replace("__", "."): value for key, value in keys.items()}
    return build_lab(loader.load("afit_simsat", LEVEL | given | {"lights": f"[{lamp}]"}))


def test_a_blinking_user_light_is_in_the_frames_in_which_it_is_lit() -> None:
    """In the truth where the lens has it, with the light of its intensity; the other frames are those without it."""
    lab = lab_with(LAMP)
    dark = build_lab(loader.load("afit_simsat", LEVEL))
    period_s = 1.0
    start_s = lab.scene.exposure.first_s
    assert start_s == period_s
    for index, is_lit in enumerate((False, True, False, True)):
        frame, truth = render_at_rest(lab.camera, lab.start, index)
        plain, _ = render_at_rest(dark.camera, dark.start, index)
        row = np.flatnonzero(truth.sources.id == LAMP_ID)
        assert len(row) == is_lit
        assert (frame.image_dn.tobytes() != plain.image_dn.tobytes()) == is_lit
        if is_lit:
            offset_m = np.array([0.0, 0.0, 1.0]) - lab.start.apply(
                lab.camera.mount.camera_body_m
            )
            expected_px = lab.camera.optics.project(truth.cam_from_lab.apply(offset_m[None]))
            np.testing.assert_allclose(truth.sources.xy_px[row], expected_px, atol=1e-6)
            strength = led_strength_e_s_sr(2e-3, "white", lab.camera.band)
            light_e = (
                strength
                * lab.camera.optics.collecting_m2
                / np.sum(offset_m**2)
                * lab.scene.exposure.time_s
            )
            assert truth.sources.electrons[row] == pytest.approx(light_e, rel=1e-3)


@pytest.mark.slow
def test_the_check_counts_a_lighthouse_among_the_lights_that_the_tracker_does_not_know() -> (
    None
):
    facts = check(lab_with(LAMP)).as_dict()["facts"]
    assert facts["other_lights"]["lighthouse"] == {"most": 1, "share": 0.5}
    same = check(build_lab(loader.load("afit_simsat", LEVEL))).as_dict()["facts"]
    assert "other_lights" not in same
    assert facts["lights_in_the_field"] == same["lights_in_the_field"]


@pytest.mark.slow
def test_a_curtain_hides_earlier_lights_and_the_forecast_names_it() -> None:
    """Lamp and LEDs beyond it are absent from the frame and listed as hidden; those before it are unchanged."""
    lamp = LAMP.replace("[0 m, ", "[0.03 m, ")
    lab = lab_with(f"{lamp}, {{kind: curtain, beyond: 0.02 m}}")
    free = lab_with(lamp)
    (_, truth), (_, open_truth) = (
        render_at_rest(one.camera, one.start, 1) for one in (lab, free)
    )
    x_m = dict(
        zip(
            lab.camera.sources.id.tolist(),
            lab.camera.sources.place[:, 0].tolist(),
            strict=True,
        )
    ) | {LAMP_ID: 0.03}
    seen = [id for id in open_truth.sources.id.tolist() if x_m[id] <= 0.02]
    assert truth.sources.id.tolist() == seen
    assert LAMP_ID in truth.hidden
    assert 0 < len(truth.hidden) <= len(open_truth.sources.id) - len(seen)
    counts = check(lab).as_dict()["facts"]["lights_in_the_field"]["frames"]
    assert set(counts["hidden"]) == {"the curtain"}
    promised = check(free).as_dict()["facts"]["lights_in_the_field"]["frames"]
    assert counts["on_chip"] + counts["hidden"]["the curtain"] == pytest.approx(
        promised["on_chip"]
    )


def test_a_lighthouse_is_a_section_of_the_scene() -> None:
    """It is read with units, written with its keys, and errors name them."""
    scene = loader.load("afit_simsat", LEVEL | {"lights": f"[{LAMP}]"})
    (config,) = scene.lights
    assert isinstance(config, LighthouseConfig)
    assert (config.place_m, config.intensity_cd, config.lit_s) == (
        (0.0, 0.0, 1.0),
        0.002,
        1.0,
    )
    written = scene.model_dump(mode="json", by_alias=True)["lights"][0]
    assert (written["kind"], written["place"], written["lit"]) == (
        "lighthouse",
        [0.0, 0.0, 1.0],
        1.0,
    )
    with pytest.raises(InputError, match=r"lights\.0\.lit: .*greater than 0"):
        loader.load("afit_simsat", {"lights": f"[{LAMP.replace('lit: 1 s', 'lit: 0 s')}]"})
    with pytest.raises(
        InputError, match=r"lights\.0\.kind: .*unknown light 'buoy'; allowed: .*lighthouse"
    ):
        loader.load("afit_simsat", {"lights": "[{kind: buoy}]"})


def test_user_lights_belong_to_the_hardware_of_every_run() -> None:
    """A lab in another run has the same lights; what a seed draws of them is drawn for the exposure."""
    lab = build_lab(loader.load("afit_simsat"))
    again = lab.in_run(lab.scene.seed + 1)
    assert again.camera.lights is lab.camera.lights
    frames = [render_at_rest(one.camera, one.start)[1].sources for one in (lab, again, lab)]
    assert frames[0].electrons.tobytes() == frames[2].electrons.tobytes()
    assert frames[0].electrons.tobytes() != frames[1].electrons.tobytes()


# What the forecast knows


BEHIND = (
    "{kind: circular, altitude: 500 km, inclination_deg: 90, raan_deg: 83, argument_deg: 180}"
)


@pytest.mark.slow
def test_the_forecast_and_the_run_agree_on_stars_behind_the_earth() -> None:
    """The camera looks at the Earth; half a revolution later the same stars are before it."""
    keys = {"exposure.frames": "2", "orbit": BEHIND}
    scene = loader.load("shefex2", keys)
    checked = check(build_lab(scene))
    facts = checked.as_dict()["facts"]
    hidden = facts["lights_in_the_field"]["frames"]["hidden"]
    free = check(
        build_lab(loader.load("shefex2", keys | {"orbit": BEHIND.replace("180", "0")}))
    )
    promised = free.as_dict()["facts"]["lights_in_the_field"]["frames"]["on_chip"]
    assert hidden == {"the Earth": pytest.approx(promised, abs=1)}
    assert facts["lights_in_the_field"]["frames"]["mean"] == 0
    assert facts["expected_error"]["frames"]["without_solution"] == 2
    (line,) = (line for line in checked.findings if "lights expected" in line)
    assert line.startswith("motion.start: ")
    assert ", all behind the Earth" in line
    assert not any("lights expected" in line for line in free.findings)
    shots = list(open_flight(scene).shots())
    assert [shot.report.attitude.solved for shot in shots if shot.report] == [False, False]
    assert all(len(shot.truth.hidden) >= promised for shot in shots)
    assert not any(len(shot.truth.sources.id) for shot in shots)


def test_the_forecast_applies_the_air_as_the_frames_do() -> None:
    """Raised, dimmed, and none below the skyline: the electrons of the forecast are those of the frame's truth."""
    night = {
        "light.air": "{scintillation: false, horizon: {azimuth_deg: [0, 180], altitude_deg: [20, 20]}}",
        "site": "{latitude_deg: 53, longitude_deg: 9}",
        "start_time": "2012-06-24T23:00:00",
        "motion.start": "{ra_deg: 222, dec_deg: -10, roll_deg: 0}",
    }
    found = check(build_lab(loader.load("shefex2", night | {"exposure.frames": "1"})))
    frames = found.as_dict()["facts"]["lights_in_the_field"]["frames"]
    assert frames["mean"] == 0
    assert set(frames["hidden"]) == {"the skyline"}
    assert any("all behind the skyline" in line for line in found.findings)


@pytest.mark.slow
def test_a_head_that_looks_at_the_earth_is_warned_of_by_its_key() -> None:
    """The main camera looks away from the Earth, the head opposite to it, through the payload's skin."""
    head = '[{name: back, position: ["0 m", "0 m", "0 m"], rotation_deg: [0, 180, 0]}]'
    keys = {
        "exposure.frames": "2",
        "orbit": BEHIND.replace("180", "0"),
        "heads": head,
        "light.occlusion": "false",
    }
    findings = check(build_lab(loader.load("shefex2", keys))).findings
    behind = [line for line in findings if "behind the Earth" in line]
    assert len(behind) == 1
    assert behind[0].startswith("heads.0.rotation_deg: ")


@pytest.mark.slow
def test_the_page_s_lighthouse_is_a_light(tmp_path: Path) -> None:
    """The block of docs/howto/light.md as a program prints what the page says."""
    page = (ROOT / "docs/howto/light.md").read_text(encoding="utf-8")
    block = re.search(r"```python\n# (\S+)\n(.*?)```", page, re.DOTALL)
    printed = re.search(r"```text\n(.*?)```", page, re.DOTALL)
    assert block
    assert printed
    (tmp_path / block[1]).write_text(block[2], encoding="utf-8")
    done = subprocess.run(
        [sys.executable, block[1]], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout == printed[1], done.stderr
