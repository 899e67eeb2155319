"""Scene files: units, and one helpful error line for every kind of bad input."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BeforeValidator, TypeAdapter, ValidationError

from skysim.camera.glow.background import BACKGROUNDS
from skysim.camera.optics import VIGNETTING
from skysim.camera.psf.otf import PSFS
from skysim.core import yaml_reader
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.units import SI_SUFFIX, ConfigModel, ErrorSchema, ToleranceConfig
from skysim.dynamics.guidance import LEGS
from skysim.dynamics.jitter import SPECTRA
from skysim.dynamics.multibody.cmgs import STEERING
from skysim.scene import loader, scene
from skysim.scene.sections import camera, leds, light, motion, surroundings, vehicle
from skysim.scene.sections.layouts import Layout
from skysim.scene.sections.leds import Lobe
from skysim.scene.sections.tracker import FilterConfig
from skysim.sources.dome.layouts.registry import LAYOUTS
from skysim.sources.dome.led import DRIVES, LOBES
from skysim.sources.dome.surface import SURFACES

AFIT = SCENES / "afit_simsat.yaml"
SHEFEX = SCENES / "shefex2.yaml"


def line_number(text: str, fragment: str) -> int:
    (line,) = [n for n, line in enumerate(text.splitlines(), 1) if fragment in line]
    return line


def complaint(path: Path, overrides: dict[str, str] | None = None) -> str:
    """One-line error text for a bad scene."""
    with pytest.raises(InputError) as refusal:
        loader.load(path, overrides)
    message = str(refusal.value)
    assert "\n" not in message
    assert len(message) < 1000
    return message


def complaint_and_place(
    tmp_path: Path, whole: Path, right: str, wrong: str
) -> tuple[str, str]:
    """The complaint about a scene with one fault in it, and `(file, line N)` of the fault."""
    text = whole.read_text()
    assert text.count(right) == 1
    path = tmp_path / "bad.yaml"
    path.write_text(text.replace(right, wrong))
    return complaint(
        path
    ), f"({path}, line {line_number(text, right.splitlines()[0].strip())})"


# Units


@pytest.mark.parametrize(
    ("key", "quantity", "value"),
    [
        ("light.surface.apex", "48 in", 1.2192),
        ("light.surface.apex", "4 ft", 1.2192),
        ("light.surface.apex", "1219.2 mm", 1.2192),
        ("light.surface.apex", "1.2192 m", 1.2192),
        ("camera.pixel", "4.0 um", 4e-6),
        ("camera.focal_length", "35 mm", 0.035),
        ("camera.focus", "33 in", 0.8382),
        ("camera.focus", "infinity", math.inf),
        ("exposure.time", "10 ms", 0.010),
        ("exposure.time", "1000 us", 0.001),
        ("exposure.first", "1 min", 60.0),
        ("vehicle.mass", "176.37 lb", 80.0),
        ("vehicle.torque_limit", "1 N m", 1.0),
        ("light.led.intensity", "16 mcd", 0.016),
        ("vehicle.wheels.torque_limit", "500 mN m", 0.5),
        ("vehicle.wheels.coulomb", "2 mN m", 2e-3),
        ("vehicle.wheels.viscous", "1e-4 N m s", 1e-4),
        ("vehicle.wheels.static_imbalance", "1 g cm", 1e-5),
        ("vehicle.wheels.dynamic_imbalance", "10 g cm2", 1e-6),
        ("vehicle.fans.thrust_limit", "0.1 lbf", 0.444822),
        ("vehicle.fans.time_constant", "200 ms", 0.2),
        ("vehicle.thrusters.minimum_impulse", "5 mN s", 5e-3),
        ("vehicle.trims.speed_limit", "10 mm/s", 0.01),
        ("vehicle.cmgs.gimbal_time_constant", "20 ms", 0.02),
        ("vehicle.cmgs.rotor_torque_limit", "0.1 N m", 0.1),
        ("vehicle.drag.viscous", "2 mN m s", 2e-3),
        ("vehicle.drag.quadratic", "3 mN m s2", 3e-3),
        ("vehicle.disturbances.cable.stiffness", "1e-3 N m / rad", 1e-3),
        ("vehicle.disturbances.cable.stiffness", "1 N m / deg", 180 / math.pi),
        ("vehicle.imu.gyro.bias_time", "5 min", 300.0),
        ("vehicle.imu.accelerometer.bias_time", "1 h", 3600.0),
    ],
)
def test_a_quantity_becomes_si(key: str, quantity: str, value: float) -> None:
    node: object = loader.load("afit_simsat", {key: quantity})
    for part in key.split("."):
        (name,) = [n for n in type(node).model_fields if SI_SUFFIX.sub("", n) == part]
        node = getattr(node, name)
    assert node == pytest.approx(value, rel=1e-5)  # a pound is 0.45359 kg


@pytest.mark.parametrize(
    ("part", "given", "name", "value"),
    [
        (
            vehicle.AirCurrentConfig,
            {"rms": ["1 mN m", "2 uN m", "0 N m"]},
            "rms_nm",
            (1e-3, 2e-6, 0.0),
        ),
        (
            vehicle.AirCurrentConfig,
            {"rms": ["0 N m"] * 3, "correlation": "1500 ms"},
            "correlation_s",
            1.5,
        ),
        (
            vehicle.DisturbancesConfig,
            {"turbine": ["1 mN m", "-1 mN m", "0 N m"]},
            "turbine_nm",
            (1e-3, -1e-3, 0.0),
        ),
        (
            motion.DesaturationConfig,
            {"start": "2 N m s", "stop": "800 mN m s"},
            "stop_nms",
            0.8,
        ),
        (
            motion.DesaturationConfig,
            {"start": "2 kg m2 / s", "stop": "1 N m s"},
            "start_nms",
            2.0,
        ),
        (
            motion.DesaturationConfig,
            {"start": "2 N m s", "stop": "1 N m s", "time": "1 min"},
            "time_s",
            60.0,
        ),
        (
            motion.BumpConfig,
            {
                "kind": "bump",
                "rate_deg_s": [1, 2, 3],
                "duration": "40 ms",
                "caught_after": "200 ms",
            },
            "caught_after_s",
            0.2,
        ),
        (FilterConfig, {"latency": "200 ms"}, "latency_s", 0.2),
        (FilterConfig, {"bias_time": "5 min"}, "bias_time_s", 300.0),
    ],
)
def test_a_section_s_quantities_become_si(
    part: type[ConfigModel], given: dict[str, object], name: str, value: object
) -> None:
    assert getattr(part.model_validate(given), name) == pytest.approx(value, rel=1e-12)


def parts_of(annotation: object) -> set[type[ConfigModel]]:
    """Every section that an annotation names, recursively."""
    if isinstance(annotation, type) and issubclass(annotation, ConfigModel):
        fields = annotation.model_fields.values()
        return {annotation}.union(*(parts_of(field.annotation) for field in fields))
    return set().union(*(parts_of(one) for one in get_args(annotation)))


def is_quantity(annotation: object, metadata: Iterable[object]) -> bool:
    """Whether an annotation, or each of its elements, takes a value such as "48 in"."""
    parsers = [one.func for one in metadata if isinstance(one, BeforeValidator)]
    sizes = [one.quantity for one in metadata if isinstance(one, ErrorSchema)]
    own = any(is_quantity(one, getattr(one, "__metadata__", ())) for one in sizes) or any(
        parser is camera.focus_distance or parser.__qualname__.startswith("quantity")
        for parser in parsers
    )
    return own or any(
        is_quantity(one, getattr(one, "__metadata__", ())) for one in get_args(annotation)
    )


SUFFIXES = (
    "_w_sr",
    "_nm_rad",
    "_kg_m2",
    "_kg_m",
    "_nms2",
    "_nms",
    "_nm",
    "_kg",
    "_cd",
    "_n",
    "_ns",
    "_m_s",
    "_m",
    "_s",
)
TOLERANCES = set(ToleranceConfig.__subclasses__())
FIELDS = [
    (part, name)
    for part in sorted(parts_of(scene.Scene) | TOLERANCES, key=str)
    for name in part.model_fields
]


@pytest.mark.parametrize(
    ("part", "name"), FIELDS, ids=[f"{part.__name__}.{name}" for part, name in FIELDS]
)
def test_a_key_has_a_unit_in_its_name_unless_its_value_has_one(
    part: type[ConfigModel], name: str
) -> None:
    """A quantity's key is its Python name less the SI suffix; every other key is the name itself."""
    field = part.model_fields[name]
    suffix = next((one for one in SUFFIXES if name.endswith(one)), "")
    bare = name.removesuffix(
        suffix if is_quantity(field.annotation, field.metadata) else ""
    ).rstrip("_")  # class_
    own = (
        {"schema_version": "schema", "name": scene.NAME_ALIAS} if part is scene.Scene else {}
    )
    assert field.alias == own.get(name, bare)


def test_the_afit_scene_has_the_thesis_s_values() -> None:
    loaded = loader.load("afit_simsat")
    # Reference §1.1: apex 48 in, semi-axes 38.88 and 28.60 in, pitch 8 mm, tilt +-30 deg, 35 mm, 1600 x 1200.
    assert loaded.light.surface.apex_m == pytest.approx(48 * 0.0254, abs=1e-12)
    assert loaded.light.surface.semi_axes_m == pytest.approx(
        (0.987552, 0.987552, 0.72644), abs=1e-12
    )
    assert loaded.light.layout.pitch_m == pytest.approx(0.008, abs=1e-15)
    assert loaded.vehicle.tilt_stop_deg == 30
    assert (loaded.camera.width_px, loaded.camera.height_px) == (1600, 1200)
    # Focused at 33 in: the chip is 36.53 mm from the lens (§1.2).
    assert loaded.camera.focal_px == pytest.approx(
        1 / (1 / 0.035 - 1 / 0.8382) / 4e-6, rel=1e-12
    )
    assert loaded.camera.image_distance_m == pytest.approx(36.53e-3, abs=5e-6)
    assert (loaded.name, loaded.seed) == ("afit_simsat", 1)
    assert loaded.start_time == datetime.datetime(2012, 3, 1, 12)


def test_a_scene_is_immutable() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        loader.load("shefex2").seed = 3


def test_a_scene_is_found_by_name_and_by_path() -> None:
    assert loader.load("shefex2") == loader.load(SHEFEX) == loader.load(str(SHEFEX))


def test_a_scene_s_camera_is_read_without_the_rest(tmp_path: Path) -> None:
    text = SHEFEX.read_text()
    alone = tmp_path / "camera.yaml"
    alone.write_text(text[text.index("camera:") : text.index("exposure:")])
    assert (
        loader.load_camera(alone)
        == loader.load_camera(SHEFEX)
        == loader.load("shefex2").camera
    )


# Overrides


def test_an_override_replaces_the_file_s_value() -> None:
    changed = loader.load(
        "afit_simsat", {"camera.detector.bits": "8", "motion.start": "{yaw_deg: 40}"}
    )
    assert changed.camera.detector.bits == 8
    assert changed.motion.start == motion.AttitudeConfig(yaw_deg=40)


def test_an_override_may_add_a_section() -> None:
    text = {"tracker.assumed_camera_body": "['1 in', '0 m', '15 in']"}
    assert loader.load(
        "afit_simsat_ideal", text
    ).tracker.assumed_camera_body_m == pytest.approx((0.0254, 0, 0.381))


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        (
            "camera.focal_lenght",
            "25 mm",
            "camera.focal_lenght: unknown key; did you mean focal_length?; allowed: ",
        ),
        (
            "exposure.time",
            "-1 ms",
            "exposure.time: '-1 ms' is not allowed; allowed: greater than or equal to 0.000001 (overrides)",
        ),
        (
            "exposure.frames",
            "0",
            "exposure.frames: 0 is not allowed; allowed: greater than or equal to 1",
        ),
        ("seed.x", "3", "seed.x: seed holds a value, not keys (overrides)"),
        ("seed", "[", "seed: '[' is not YAML (overrides)"),
        ("camera..bits", "3", "overrides: camera..bits=3; allowed: path.to.key=value"),
        (
            "camera",
            "",
            "camera: None is not allowed; allowed: a mapping of keys to values (overrides)",
        ),
        ("exposure.time", "a\nb", "is not a time; allowed: a time such as"),
    ],
)
def test_a_bad_override_is_refused_in_one_line_that_names_the_option(
    key: str, value: str, says: str
) -> None:
    message = complaint(SHEFEX, {key: value})
    assert says in message
    assert "overrides" in message
    assert str(SHEFEX) not in message


# Faults in a file


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        (
            "falloff: inverse_square",
            "falloff: cubic",
            "light.led.falloff: 'cubic' is not allowed; allowed: 'inverse_square'",
        ),
        (
            "  kind: dome",
            "  kind: domes",
            "light.kind: unknown kind 'domes'; allowed: dome, stars, collimated_display",
        ),
        (
            "kind: ellipsoid",
            "kind: torus",
            "light.surface.kind: unknown kind 'torus'; allowed: sphere, ",
        ),
        (
            "control: pid",
            "control: l q r",
            "motion.control: 'l q r' is not allowed; allowed: letters, digits",
        ),
        (
            'apex: "48 in"',
            'apexx: "48 in"',
            "light.surface.apexx: unknown key; did you mean apex?; allowed: kind, ",
        ),
        (
            'apex: "48 in"',
            'apex: "48 kg"',
            "light.surface.apex: '48 kg' is not a length; allowed: a length such as",
        ),
        (
            'apex: "48 in"',
            'apex: "48"',
            "light.surface.apex: '48' is not a length; allowed: a length such as",
        ),
        (
            'apex: "48 in"',
            "apex: 48",
            'light.surface.apex: 48 has no unit; allowed: a length such as "35 mm"',
        ),
        (
            'apex: "48 in"',
            'apex: "-48 in"',
            "light.surface.apex: '-48 in' is not allowed; allowed: greater than",
        ),
        (
            '"38.88 in", "28.60 in"]',
            '"38.88 in", "0 in"]',
            "light.surface.semi_axes.2: '0 in' is not allowed",
        ),
        (
            'time: "10 ms"',
            'time: "-10 ms"',
            "exposure.time: '-10 ms' is not allowed; allowed: greater than or equal to 0.000001",
        ),
        (
            'time: "10 ms"',
            'time: "nan ms"',
            "exposure.time: nan is not allowed; allowed: a finite number",
        ),
        (
            'time: "10 ms"',
            'time: "1e400 ms"',
            "exposure.time: '1e400 ms'; allowed: a time up to",
        ),
        (
            "f_number: 8",
            "f_number: .nan",
            "camera.f_number: nan is not allowed; allowed: a finite",
        ),
        (
            "preset: lu205c",
            "width_px: 1600.5\n  preset: lu205c",
            "camera.width_px: 1600.5 is not allowed; allowed: a valid integer",
        ),
        (
            "preset: lu205c",
            "detector: {bits: 17}\n  preset: lu205c",
            "camera.detector.bits: 17 is not allowed; allowed: less than or equal to 16",
        ),
        ("lit: [3, 6]", "lit: [3, 12]", "allowed: 1 <= least <= most <= 9"),
        ("lit: [3, 6]", "lit: [3]", "light.layout.lit.1: missing"),
        (
            "pwm_levels: [1.0, 0.7, 0.5, 0.35]",
            "pwm_levels: []",
            "light.layout.pwm_levels: [] is not allowed",
        ),
        (
            "hardware_seed: 2012",
            "hardware_seed: -1",
            "light.layout.hardware_seed: -1 is not allowed",
        ),
        (
            '"9.0 kg m2"',
            '"90 kg m2"',
            "is not possible for a rigid body; allowed: positive, none above the sum of the others",
        ),
        ("schema: 1", "schema: 2", "schema: version 2 is newer than skysim "),
        ("schema: 1", "schema: 0", "schema: version 0 is no longer supported; allowed: 1"),
        ("schema: 1", "schema: yes", "schema: unknown version True; allowed: 1"),
        ("seed: 1\n", "seed: one\n", "seed: 'one' is not allowed; allowed: a valid integer"),
        (
            "2012-03-01T12:00:00",
            "yesterday",
            "start_time: 'yesterday' is not a date; allowed: an ISO date, or date and time",
        ),
        ("title: AFIT", "name: x\ntitle: AFIT", "name: unknown key"),
        (
            'duration: "1 s"',
            'durations: "1 s"',
            "unknown key; did you mean duration?; allowed: kind, duration",
        ),
        (
            '{kind: hold, duration: "1 s"}',
            '{kind: wait, duration: "1 s"}',
            "motion.maneuver.0.kind: unknown kind 'wait'; allowed: hold, step, slew, rate, spin_up, sine, chirp, "
            "profile, jitter, bump",
        ),
        (
            "pitch_deg: 0",
            "pich_deg: 0",
            "motion.start.pich_deg: unknown key; did you mean pitch_deg?; allowed: roll_",
        ),
    ],
)
def test_a_wrong_value_is_reported_with_key_allowed_values_and_line(
    tmp_path: Path, right: str, wrong: str, says: str
) -> None:
    message, place = complaint_and_place(tmp_path, AFIT, right, wrong)
    assert says in message
    assert message.endswith(place)


@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        (
            "ra_deg: 83.0",
            "ra_deg: 400",
            "motion.start.ra_deg: 400 is not allowed; allowed: less than 360",
        ),
        (
            "dec_deg: 2.0",
            "dec_deg: -91",
            "motion.start.dec_deg: -91 is not allowed; allowed: greater than",
        ),
        (
            "ra_deg: 83.0",
            "ra_deg: .nan",
            "motion.start.ra_deg: nan is not allowed; allowed: a finite number",
        ),
        (
            "dec_deg: 2.0",
            "decl_deg: 2.0",
            "motion.start.decl_deg: unknown key; did you mean dec_deg?; allowed: ra_deg",
        ),
        ("dec_deg: 2.0, roll_deg: 20.0", "roll_deg: 20.0", "motion.start.dec_deg: missing"),
        (
            "ra_deg: 83.0, dec_deg: 2.0, ",
            "",
            "motion.start: light of kind stars requires ra_deg, dec_deg, roll_deg",
        ),
    ],
)
def test_an_error_in_pointing_is_not_reported_as_a_vehicle_error(
    tmp_path: Path, right: str, wrong: str, says: str
) -> None:
    message, place = complaint_and_place(tmp_path, SHEFEX, right, wrong)
    assert says in message
    assert message.endswith(place)


def test_a_dome_with_a_start_in_the_sky_is_refused(tmp_path: Path) -> None:
    right = "start: {roll_deg: 0, pitch_deg: 0, yaw_deg: 0}"
    message, place = complaint_and_place(
        tmp_path, AFIT, right, "start: {ra_deg: 83, dec_deg: 2}"
    )
    assert (
        message
        == f"motion.start: light of kind dome requires roll_deg, pitch_deg, yaw_deg {place}"
    )


# Unions: of each the allowed kinds, as a wrong one is answered

UNIONS = [
    (
        "kind: gaussian",
        "kind: gauss",
        "camera.psf.kind",
        "gaussian, moffat, airy, disk, measured",
    ),
    (
        "kind: global",
        "kind: shut",
        "camera.shutter.kind",
        "global, rolling, frame_transfer, interline",
    ),
    (
        "transmission: 0.85",
        "vignetting: {kind: cos4}\n  transmission: 0.85",
        "camera.vignetting.kind",
        "two_stops, table",
    ),
    ("kind: cosine", "kind: square", "light.led.lobe.kind", "cosine, table"),
    (
        "exposure: {",
        "background: [{kind: uniform, e_s: 3}, {kind: aurora}]\nexposure: {",
        "background.1.kind",
        "uniform, sky, moon, stray, faint_stars, zodiacal",
    ),
    (
        "control: pid",
        "jitter: [{kind: white}]\n  control: pid",
        "motion.jitter.0.kind",
        "line, band",
    ),
    (
        "preset: lu205c",
        "preset: lu206c",
        "camera.preset",
        r"aps, cmv4000, ec655, [\w, ]+, wat902h2, or a \.yaml file with a camera",
    ),
]


@pytest.mark.parametrize(("right", "wrong", "key", "allowed"), UNIONS)
def test_an_unknown_kind_is_answered_with_the_known_ones(
    tmp_path: Path, right: str, wrong: str, key: str, allowed: str
) -> None:
    message, place = complaint_and_place(tmp_path, AFIT, right, wrong)
    assert re.fullmatch(
        rf"{re.escape(key)}: unknown \w+ '\w+'; allowed: {allowed} {re.escape(place)}",
        message,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("camera.psf", "{kind: moffat}", "camera.psf.fwhm_px: missing"),
        (
            "camera.psf",
            "{kind: disk, radius_px: 0}",
            "camera.psf.radius_px: 0 is not allowed",
        ),
        ("camera.psf", "{sigma_px: 0.5, fwhm_px: 2}", "camera.psf: kind is missing"),
        (
            "camera.psf",
            "{kind: airy, wavelength: 550}",
            "camera.psf.wavelength: 550 has no unit",
        ),
        ("camera.shutter", "{kind: frame_transfer}", "camera.shutter.row_time: missing"),
        (
            "camera.shutter",
            "{kind: rolling, row_time: 1 ms}",
            "camera.shutter: readout takes 1.199 s, longer than the frame period 0.5 s",
        ),
        (
            "light.led.intensity",
            "null",
            "light.led: an LED takes either intensity or radiant_intensity",
        ),
        (
            "light.led.radiant_intensity",
            "3 mW/sr",
            "light.led: an LED takes either intensity or radiant_",
        ),
        (
            "light.led.lobe",
            "{kind: table, angle_deg: [0, 60], intensity: [20, 1]}",
            "light.led.lobe: the table does not begin with an intensity of 1 at 0 deg",
        ),
        (
            "camera.shutter",
            "{kind: global, row_time: '3 us'}",
            "camera.shutter.row_time: unknown key",
        ),
        (
            "camera.vignetting",
            "{kind: two_stops, cutoff_deg: 90}",
            "camera.vignetting.cutoff_deg: 90 is not",
        ),
        (
            "camera.vignetting",
            "{kind: two_stops, cutof_deg: 9}",
            "camera.vignetting.cutof_deg: unknown key; did you mean cutoff_deg?",
        ),
        (
            "camera.vignetting",
            "{kind: table, angle_deg: [0, 5, 5], transmission: [1, 1, 1]}",
            "camera.vignetting: angle_deg is not strictly ascending",
        ),
        (
            "light.led.lobe",
            "{kind: table, angle_deg: [0, 5, 9], intensity: [1, 1]}",
            "light.led.lobe: angle_deg has 3 numbers, intensity has 2",
        ),
        (
            "motion.jitter",
            "[{kind: band, from_hz: 9, to_hz: 3, rms_arcsec: [1, 1, 1]}]",
            "is not below to_hz 3",
        ),
        (
            "background",
            "[{kind: sky, mag_arcsec: 20}]",
            "background.0.mag_arcsec: unknown key; did you mean mag",
        ),
        (
            "camera.detector.particles",
            "[{per_cm2_s: -1}]",
            "camera.detector.particles.0.per_cm2_s: -1 is not",
        ),
        (
            "camera.detector.quantum_efficiency",
            "ccd",
            "unknown curve 'ccd'; allowed: bayer_blue",
        ),
        (
            "camera.detector.offset_dn",
            "1024",
            "camera.detector.offset_dn: 1024 is beyond the range of 10 bits",
        ),
    ],
)
def test_an_error_within_a_kind_is_reported_for_that_kind_alone(
    key: str, value: str, says: str
) -> None:
    message = complaint(AFIT, {key: value})
    assert says in message
    assert "tagged-union" not in message


# Rules between sections: who flies, with what, at which rate


UNLOAD = "{start: 2 N m s, stop: 1 N m s}"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"filter": "{}"}, "filter: requires the section vehicle.imu"),
        *(
            (
                {"motion.control": f"{{actuators: {kind}}}"},
                f"motion.control.actuators: requires the section vehicle.{kind}",
            )
            for kind in ("wheels", "cmgs", "fans", "thrusters", "trims")
        ),
        *(
            (
                {"motion.control": f"{{actuators: {kind}, desaturation: {UNLOAD}}}"} | more,
                "motion.control.desaturation: requires vehicle.fans, and actuators wheels or cmgs",
            )
            for kind, more in (
                ("ideal", {"vehicle.fans": "{}"}),
                ("wheels", {"vehicle.wheels": "{}"}),
                ("fans", {"vehicle.fans": "{}"}),
            )
        ),
        (
            {"tracker.exposure_control": "{mean_dn: 150, longest: 600 ms}"},
            "tracker.exposure_control.longest: 0.6 s is longer than the frame period 0.5 s",
        ),
        (
            {"tracker.exposure_control": "{mean_dn: 150, longest: 8 ms}"},
            "tracker.exposure_control: exposure.time 0.01 s, of the first frame, is outside 1e-05 s to 0.008 s",
        ),
        (
            {"tracker.exposure_control": "{mean_dn: 150, shortest: 60 ms}"},
            "tracker.exposure_control.shortest: 0.06 s is above longest 0.05 s",
        ),
        (
            {"tracker.exposure_control": "{mean_dn: 150, longest: 11 s}"},
            "tracker.exposure_control.longest: '11 s' is not allowed; allowed: less than or equal to 10",
        ),
        (
            {"tracker.exposure_control": "{mean_dn: 150, step: 0.1 us}"},
            "tracker.exposure_control.step: '0.1 us' is not allowed; allowed: greater than or equal to 0.000001",
        ),
        (
            {"tracker.exposure_control": "{step: 2 ms}"},
            "tracker.exposure_control.mean_dn: missing",
        ),
        (
            {"motion.control": "{feedback: imu}"},
            "motion.control.feedback: imu requires the section vehicle.imu",
        ),
        (
            {"motion.control": "{feedback: filter}", "vehicle.imu": "{}"},
            "motion.control.feedback: filter requires the section filter",
        ),
        (
            {"motion.control": "{rate_hz: 300}"},
            "motion.control.rate_hz: 300 Hz has a period that is not a whole number of milliseconds",
        ),
        (
            {"vehicle.imu": "{rate_hz: 250}"},
            "vehicle.imu.rate_hz: 250 Hz is not a multiple of motion.control.rate_hz 100 Hz",
        ),
        (
            {"vehicle.imu": "{rate_hz: 100}", "filter": "{bias_time: 90 ms}"},
            "filter.bias_time: shorter than ten samples of the IMU, 0.1 s",
        ),
        (
            {
                "motion.maneuver": "[{kind: sine, amplitude_deg: [1, 0, 0], frequency_hz: 50, duration: 1 s}]"
            },
            "motion.maneuver: a sine of 50 Hz requires a motion.control.rate_hz above 100",
        ),
        (
            {"motion.control": f"{{desaturation: {UNLOAD.replace('2', '0.5')}}}"},
            "motion.control.desaturation.stop: 1 N m s is not below start 0.5 N m s",
        ),
        (
            {
                "motion.maneuver": "[{kind: bump, rate_deg_s: [1, 2, 3], duration: 40 ms, caught_after: 30 ms}]"
            },
            "motion.maneuver.0.caught_after: 0.03 s is before the impulse ends",
        ),
    ],
)
def test_contradicting_keys_are_refused_in_one_line(
    changes: dict[str, str], says: str
) -> None:
    assert complaint(AFIT, changes) == f"{says} (overrides)"


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        *(
            (
                "vehicle.disturbances",
                value,
                "vehicle.disturbances: a free vehicle has none; allowed: mount:",
            )
            for value in (
                "{earth_rotation: true}",
                "{turbine: [0 N m, 0 N m, 1 mN m]}",
                "{cable: {stiffness: 1 N m / rad}}",
                "{air_current: {rms: [1 mN m, 1 mN m, 1 mN m]}}",
            )
        ),
        *(
            (
                "vehicle.imu",
                f"{{earth_rate: {rate}}}",
                "vehicle.imu.earth_rate: a free vehicle is not on the Earth; allowed: none",
            )
            for rate in ("compensated", "uncompensated")
        ),
    ],
)
def test_keys_of_a_room_are_refused_for_a_free_vehicle(
    key: str, value: str, says: str
) -> None:
    free = {"vehicle.mount": "free", "vehicle.center_of_mass": "[0 m, 0 m, 0 m]"}
    assert says in complaint(AFIT, free | {key: value})
    assert (
        loader.load(AFIT, {key: value}).vehicle.mount == "air_bearing"
    )  # where it may have it


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        (
            "vehicle.wheels",
            "{coulomb: 1 mN}",
            "coulomb: '1 mN' is not a torque; allowed: a torque such as",
        ),
        (
            "vehicle.wheels",
            "{coulomb: -1 mN m}",
            "vehicle.wheels.coulomb: '-1 mN m' is not allowed; allowed: gr",
        ),
        (
            "vehicle.wheels",
            "{torque: 1 N m}",
            "vehicle.wheels.torque: unknown key; did you mean torque_limit?; allo",
        ),
        (
            "vehicle.wheels",
            "{static_imbalance: 1 g}",
            "'1 g' is not a mass times offset; allowed: a mass ti",
        ),
        (
            "vehicle.fans",
            "{thrust_limit: 1 N m}",
            "'1 N m' is not a force; allowed: a force such as",
        ),
        (
            "vehicle.drag",
            "{viscous: 1 N m}",
            "vehicle.drag.viscous: '1 N m' is not a torque per rate; allow",
        ),
        (
            "vehicle.drag",
            "{quadratic: 1 N m s}",
            "'1 N m s' is not a torque per squared rate; allowed: a t",
        ),
        (
            "vehicle.cmgs",
            "{steering: magic}",
            "allowed: 'pseudo_inverse' or 'singularity_robust'",
        ),
        (
            "vehicle.cmgs",
            "{gimbal_time_constant: 1 ms}",
            "allowed: greater than or equal to 0.005",
        ),
        (
            "vehicle.disturbances",
            "{cable: {}}",
            "vehicle.disturbances.cable.stiffness: missing",
        ),
        (
            "vehicle.disturbances",
            "{cable: {stiffness: 1 N m}}",
            "'1 N m' is not a torque per angle; allowed: ",
        ),
        (
            "vehicle.disturbances",
            "{air_current: {rms: [1 N m]}}",
            "vehicle.disturbances.air_current.rms.1: missing",
        ),
        (
            "vehicle.imu",
            "{earth_rate: maybe}",
            "allowed: 'none', 'uncompensated' or 'compensated'",
        ),
        (
            "vehicle.imu",
            "{gyro: {arw: 3}}",
            "vehicle.imu.gyro.arw: unknown key; allowed: arw_deg_sqrt_h, ",
        ),
        (
            "motion.control",
            "{law: pid, options: {a: 1}}",
            "motion.control: options has no effect with law pid; allo",
        ),
        (
            "motion.control",
            "{law: prescribed, damping: 1}",
            "motion.control: damping has no effect with law prescr",
        ),
        (
            "motion.control",
            "{rate_hz: 0.5}",
            "motion.control.rate_hz: 0.5 is not allowed; allowed: gr",
        ),
        (
            "motion.control",
            "true",
            "motion.control: True is not allowed; allowed: a mapping of keys to",
        ),
        (
            "site",
            "{latitude_deg: 91}",
            "site.latitude_deg: 91 is not allowed; allowed: less than or equal",
        ),
        (
            "filter",
            "{latency: -1 s}",
            "filter.latency: '-1 s' is not allowed; allowed: greater than or",
        ),
        (
            "filter",
            "{considered: [gain]}",
            "allowed: 'bias', 'scale', 'misalignment', 'mounting' or 'systematic'",
        ),
        (
            "filter",
            "{wrong_share: 1}",
            "filter.wrong_share: 1 is not allowed; allowed: less than 1",
        ),
        (
            "filter",
            "{scale_ppm: -1}",
            "filter.scale_ppm: -1 is not allowed; allowed: greater than or",
        ),
        (
            "filter",
            "{systematic_time: 0 s}",
            "filter.systematic_time: '0 s' is not allowed; allowed: greater than",
        ),
    ],
)
def test_an_error_in_the_vehicle_is_reported_with_its_key(
    key: str, value: str, says: str
) -> None:
    message = complaint(AFIT, {key: value})
    assert says in message
    assert message.endswith("(overrides)")


@pytest.mark.parametrize("kind", ["hold", "jitter", "bump"])
def test_elements_without_commands_need_no_controller(kind: str) -> None:
    more = {
        "hold": "",
        "jitter": ", components: [{kind: line, frequency_hz: 9, rms_arcsec: [1, 1, 1]}]",
        "bump": ", rate_deg_s: [1, 1, 1]",
    }[kind]
    settings = {
        "motion.maneuver": f"[{{kind: {kind}, duration: 1 s{more}}}]",
        "motion.control": "none",
    }
    assert loader.load(AFIT, settings).motion.control is None


def test_a_controller_s_name_abbreviates_its_section() -> None:
    loaded = [
        loader.load(AFIT, {"motion.control": value}).motion.control
        for value in ("pd", "{law: pd}")
    ]
    assert loaded[0] == loaded[1] == motion.ControlConfig(law="pd")


# A scene on top of another


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def test_a_scene_overrides_its_base(tmp_path: Path) -> None:
    """Keys of a section are merged at every depth; a list is taken whole; the name is the file's own."""
    mine = written(
        tmp_path,
        "mine.yaml",
        "schema: 1\nbase: afit_simsat\ntitle: Mine\nexposure: {frames: 3}\nlight: {led: {scatter: 0.01}}\n"
        'motion:\n  maneuver: [{kind: hold, duration: "2 s"}]\n',
    )
    base = loader.load("afit_simsat")
    loaded = loader.load(mine)
    assert (loaded.name, loaded.title) == ("mine", "Mine")
    assert loaded.exposure == base.exposure.model_copy(update={"frames": 3})
    led = base.light.led.model_copy(update={"scatter": 0.01})
    assert loaded.light == base.light.model_copy(update={"led": led})
    assert [one.kind for one in loaded.motion.maneuver] == ["hold"]
    same = ("vehicle", "camera", "tracker", "seed", "start_time")
    assert all(getattr(loaded, key) == getattr(base, key) for key in same)


def test_a_section_of_another_kind_replaces_the_base_s(tmp_path: Path) -> None:
    surface = "light: {surface: {kind: sphere, apex: 1 m, radius: 90 cm}}"
    loaded = loader.load(
        written(tmp_path, "mine.yaml", f"schema: 1\nbase: afit_simsat\n{surface}\n")
    )
    assert loaded.light.surface == TypeAdapter(light.AnySurface).validate_python(
        {"kind": "sphere", "apex": "1 m", "radius": "90 cm"}
    )


def test_null_switches_a_section_of_the_base_off(tmp_path: Path) -> None:
    assert loader.load("simsat_slew").vehicle.wheels
    mine = "schema: 1\nbase: simsat_slew\nvehicle: {wheels: null, fans: null}\nmotion: {control: null, maneuver: []}\n"
    loaded = loader.load(written(tmp_path, "mine.yaml", mine))
    assert (loaded.vehicle.wheels, loaded.vehicle.fans, loaded.motion.control) == (
        None,
        None,
        None,
    )
    assert loaded.vehicle.drag == loader.load("simsat_slew").vehicle.drag


def test_a_base_is_found_beside_the_scene_and_may_have_its_own_base(tmp_path: Path) -> None:
    """Files named in the base are resolved beside the base, not beside the scene."""
    model = (SCENES / "vehicles" / "simsat.xml").read_text()
    written(tmp_path, "below/own.xml", model)
    written(
        tmp_path,
        "below/lower.yaml",
        "schema: 1\nbase: simsat_slew\nvehicle: {model: own.xml}\nseed: 77\n",
    )
    mine = written(
        tmp_path, "mine.yaml", "schema: 1\nbase: below/lower.yaml\ntitle: Mine on top\n"
    )
    loaded = loader.load(mine)
    assert loaded.vehicle.model == str(tmp_path / "below" / "own.xml")
    assert (loaded.seed, loaded.title) == (77, "Mine on top")
    assert loaded.exposure == loader.load("simsat_slew").exposure
    assert loaded.camera == loader.load("afit_simsat").camera == loader.load_camera(mine)


def test_an_override_precedes_scene_and_base(tmp_path: Path) -> None:
    mine = written(tmp_path, "mine.yaml", "schema: 1\nbase: afit_simsat\nseed: 2\n")
    loaded = loader.load(mine, {"seed": "3", "exposure.frames": "7"})
    assert (loaded.seed, loaded.exposure.frames) == (3, 7)


@pytest.mark.parametrize(
    ("base", "says"),
    [
        (
            "nosuch",
            "base: nosuch: no such scene; allowed: a .yaml file or one of afit_as_built, ",
        ),
        ("nosuch.yaml", "base: nosuch.yaml: no such scene; allowed: a .yaml file or one of "),
        ("3", "base: 3: no such scene; allowed: "),
        ("", "base: None: no such scene; allowed: "),
        ("[a, b]", "base: ['a', 'b']: no such scene; allowed: "),
        ("mine.yaml", "base: mine.yaml leads back to this scene"),
        ("../mine/mine.yaml", "base: ../mine/mine.yaml leads back to this scene"),
    ],
)
def test_an_unusable_base_is_refused_in_one_line(
    tmp_path: Path, base: str, says: str
) -> None:
    path = written(tmp_path / "mine", "mine.yaml", f"schema: 1\ntitle: Mine\nbase: {base}\n")
    message = complaint(path)
    assert message.startswith(says)
    assert message.endswith(f"({path}, line 3)")


def test_scenes_that_are_each_other_s_base_are_refused(tmp_path: Path) -> None:
    one = written(tmp_path, "one.yaml", "schema: 1\nbase: two.yaml\n")
    written(tmp_path, "two.yaml", "schema: 1\nbase: three.yaml\n")
    three = written(tmp_path, "three.yaml", "schema: 1\ntitle: Three\nbase: one.yaml\n")
    says = "base: one.yaml leads back to this scene"
    assert complaint(one) == f"{says} ({three}, line 3)"


def test_an_error_is_reported_with_the_file_that_contains_it(tmp_path: Path) -> None:
    """Its own where it is above, the base's where it is there; a section between is in both."""
    lower = written(
        tmp_path,
        "lower.yaml",
        "schema: 1\nbase: afit_simsat\nexposure:\n  frames: 0\n  rate_hz: 2\n",
    )
    mine = written(
        tmp_path,
        "mine.yaml",
        "schema: 1\nbase: lower.yaml\nseed: 3\nexposure:\n  rate_hz: 1\n",
    )
    says = "exposure.frames: 0 is not allowed; allowed: greater than or equal to 1"
    assert complaint(mine) == f"{says} ({lower}, line 4)"
    mine.write_text(
        "schema: 1\nbase: lower.yaml\nseed: 3\n\nexposure:\n  rate_hz: 1\n  frames: -1\n"
    )
    assert complaint(mine) == f"{says.replace('0 is', '-1 is')} ({mine}, line 7)"
    assert complaint(mine, {"exposure.frames": "0"}) == f"{says} (overrides)"


def test_a_list_replaces_the_base_s_list_whole(tmp_path: Path) -> None:
    """The base's first element has a duration, but the scene's list replaces the base's."""
    mine = written(
        tmp_path,
        "mine.yaml",
        "schema: 1\nbase: afit_simsat\nmotion:\n  maneuver:\n    - {kind: hold}\n",
    )
    assert complaint(mine) == f"motion.maneuver.0.duration: missing ({mine}, line 5)"


def test_a_base_that_is_not_yaml_is_refused_in_one_line(tmp_path: Path) -> None:
    lower = written(tmp_path, "lower.yaml", "title: [")
    mine = written(tmp_path, "mine.yaml", "schema: 1\nbase: lower.yaml\n")
    assert complaint(mine).startswith(f"{lower}, line 1: not YAML: ")


# The camera: preset and focus


def test_a_scene_s_keys_precede_its_camera_preset(tmp_path: Path) -> None:
    """Keys of a section are merged; a section of another kind replaces the preset's."""
    path = tmp_path / "mine.yaml"
    path.write_text(
        SHEFEX.read_text().replace(
            "preset: ec655",
            "preset: ec655\n  width_px: 640\n  detector: {read_noise_e: 9}\n  shutter: {kind: global}",
        )
    )
    plain = loader.load("shefex2").camera
    mine = loader.load(path).camera
    assert (mine.width_px, mine.detector.read_noise_e, mine.shutter.kind) == (
        640,
        9.0,
        "global",
    )
    assert (plain.width_px, plain.detector.read_noise_e, plain.shutter.kind) == (
        659,
        14.7,
        "interline",
    )
    changed = {"width_px": 640, "shutter": mine.shutter, "detector": mine.detector}
    assert mine == plain.model_copy(update=changed)
    assert mine.detector == plain.detector.model_copy(update={"read_noise_e": 9.0})
    assert loader.load_camera(path) == mine


def test_an_override_precedes_the_preset() -> None:
    assert loader.load("shefex2", {"camera.detector.bits": "8"}).camera.detector.bits == 8
    other = loader.load("shefex2", {"camera.preset": "aps"}).camera
    assert (other.width_px, other.shutter.kind, other.focal_length_m) == (
        1024,
        "rolling",
        0.025,
    )


def test_a_lens_is_focused_at_infinity_by_default() -> None:
    lens = loader.load("shefex2").camera
    assert lens.focus_m == math.inf
    assert lens.image_distance_m == pytest.approx(0.025, rel=1e-15)


@pytest.mark.parametrize("focus", ["70 mm", "35 mm", "1 um"])
def test_a_focus_nearer_than_twice_the_focal_length_is_refused(
    tmp_path: Path, focus: str
) -> None:
    """Nearer, the image would be larger than the object; at the focal length there is no image."""
    message, _ = complaint_and_place(tmp_path, AFIT, 'focus: "33 in"', f'focus: "{focus}"')
    assert re.match(
        r"camera.focus: \S+ m is less than twice the focal length 0.035 m \(", message
    )


@pytest.mark.parametrize(
    ("focus", "says"),
    [
        ("0 m", "camera.focus: '0 m' is not allowed; allowed: greater than 0"),
        ("-33 in", "camera.focus: '-33 in' is not allowed; allowed: greater than 0"),
        ("nan m", "camera.focus: 'nan m' is not allowed"),
        (
            "far",
            "camera.focus: 'far' is not a length; allowed: a length such as \"33 in\", or infinity",
        ),
        (
            "33",
            'camera.focus: 33 has no unit; allowed: a length such as "33 in", or infinity',
        ),
    ],
)
def test_a_focus_that_is_not_a_distance_is_refused(focus: str, says: str) -> None:
    assert says in complaint(AFIT, {"camera.focus": focus})


def test_a_missing_key_is_named_with_its_section_s_line(tmp_path: Path) -> None:
    message, _ = complaint_and_place(tmp_path, AFIT, '    apex: "48 in"\n', "")
    line = line_number(AFIT.read_text(), "surface:")
    assert message == f"light.surface.apex: missing ({tmp_path / 'bad.yaml'}, line {line})"


def test_a_missing_section_is_named(tmp_path: Path) -> None:
    message, _ = complaint_and_place(tmp_path, AFIT, "seed: 1\n", "")
    assert message == f"seed: missing ({tmp_path / 'bad.yaml'})"


def test_an_exposure_longer_than_its_period_is_refused(tmp_path: Path) -> None:
    message, place = complaint_and_place(tmp_path, AFIT, 'time: "10 ms"', 'time: "10 s"')
    late = "plus trigger_jitter 0.0001 s"
    assert (
        message
        == f"exposure.time: 10.0 s {late} is longer than the frame period 0.5 s {place}"
    )


def test_a_maneuver_without_a_controller_is_refused(tmp_path: Path) -> None:
    message, _ = complaint_and_place(tmp_path, AFIT, "control: pid", "control: none")
    allowed = "such as control: pid; allowed: maneuver: [] without one"
    assert message.startswith(f"motion: a maneuver requires a controller, {allowed}")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [1, 2", "not YAML"),
        ("a:\n\t- b", "line 2: not YAML"),
        ("a: \x00", "not YAML: unacceptable character"),
        ("", "allowed: a mapping of keys to values"),
        ("- 1\n- 2\n", "allowed: a mapping of keys to values"),
        ("just words", "allowed: a mapping of keys to values"),
        ("schema: 1\n1: 2\n", "1: 1 is not allowed"),
    ],
)
def test_a_file_without_a_scene_is_refused_in_one_line(
    tmp_path: Path, text: str, says: str
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    message = complaint(path)
    assert says in message
    assert str(path) in message


def test_bytes_that_are_not_text_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(b"\xff\xfe\x80\x81")
    assert f"{path}: cannot be read" in complaint(path)


@pytest.mark.parametrize("name", ["nosuch", "nosuch.yaml", "scenes/nosuch", "", "."])
def test_an_unknown_scene_is_answered_with_the_known_ones(name: str) -> None:
    with pytest.raises(
        InputError,
        match=r"no such scene; allowed: a \.yaml file or one of .*afit_simsat.*shefex2",
    ):
        loader.load(name)


def test_a_camera_file_without_a_camera_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("schema: 1\ntitle: no camera\n")
    with pytest.raises(InputError, match=r"^camera: missing \(.*camera\.yaml\)$"):
        loader.load_camera(path)


def kinds(union: object) -> set[str]:
    """The kinds of a discriminated union."""
    return {
        get_args(part.model_fields["kind"].annotation)[0]
        for part in get_args(get_args(union)[0])
    }


def test_every_algorithm_that_the_schema_names_exists() -> None:
    assert set(light.SurfaceConfig.model_fields["kind"].annotation.__args__) == set(SURFACES)
    assert kinds(Layout) == set(LAYOUTS)
    assert kinds(leds.Drive) == set(DRIVES)
    assert set(vehicle.CmgsConfig.model_fields["steering"].annotation.__args__) == set(
        STEERING
    )
    assert kinds(camera.Psf) == set(PSFS)
    assert kinds(
        get_args(camera.CameraConfig.model_fields["vignetting"].annotation)[0]
    ) == set(VIGNETTING)
    assert kinds(Lobe) == set(LOBES)
    assert kinds(surroundings.Glow) == set(BACKGROUNDS)
    assert kinds(motion.JitterPart) == set(SPECTRA)
    assert kinds(motion.Maneuver) == set(LEGS)


def test_a_duplicate_key_is_refused(tmp_path):
    """A plain YAML loader would silently take the last one."""
    path = tmp_path / "twice.yaml"
    path.write_text((SCENES / "shefex2.yaml").read_text() + "\nseed: 3\n")
    with pytest.raises(InputError, match=r"^seed: duplicate key \(.*twice.yaml, line \d+\)$"):
        loader.load(path)


def test_items_below_a_key_with_dots_have_their_own_lines() -> None:
    text = "factors:\n  camera.f_number:\n    - 1\n    - 2\n  seed: {low: 1,\n    high: 2}\n"
    assert yaml_reader.line_of(text, ["factors", "camera", "f_number", "1"]) == (4, 4)
    assert yaml_reader.line_of(text, ["factors", "seed", "high"]) == (3, 6)
