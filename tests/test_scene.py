"""Units are what they say, and every kind of bad input is one line that helps."""

from __future__ import annotations

import datetime
import math
import re
from pathlib import Path
from typing import get_args

import pytest
from pydantic import ValidationError

from skysim import camera, light, scene
from skysim.background import BACKGROUNDS
from skysim.dome import LAYOUTS, SURFACES
from skysim.jitter import SPECTRA
from skysim.led import LOBES
from skysim.optics import VIGNETTING
from skysim.psf import PSFS
from skysim.quantity import SI_SUFFIX
from skysim.types import BadInput

AFIT, SHEFEX = scene.SCENES / "afit_simsat.yaml", scene.SCENES / "shefex2.yaml"


def line_number(text: str, fragment: str) -> int:
    (line,) = [n for n, line in enumerate(text.splitlines(), 1) if fragment in line]
    return line


def complaint(path: Path, overrides: dict[str, str] | None = None) -> str:
    """The one line that a bad scene gets."""
    with pytest.raises(BadInput) as refusal:
        scene.load(path, overrides)
    message = str(refusal.value)
    assert "\n" not in message
    assert len(message) < 400
    return message


def spoilt(tmp_path: Path, whole: Path, right: str, wrong: str) -> tuple[str, str]:
    """The complaint about a scene with one slip in it, and `(file, line N)` of the slip."""
    text = whole.read_text()
    assert text.count(right) == 1
    path = tmp_path / "bad.yaml"
    path.write_text(text.replace(right, wrong))
    return complaint(path), f"({path}, line {line_number(text, right.splitlines()[0].strip())})"


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
    ],
)
def test_a_quantity_becomes_si(key: str, quantity: str, value: float) -> None:
    node: object = scene.load("afit_simsat", {key: quantity})
    for part in key.split("."):
        (name,) = [n for n in type(node).model_fields if SI_SUFFIX.sub("", n) == part]
        node = getattr(node, name)
    assert node == pytest.approx(value, rel=1e-5)  # a pound is 0.45359 kg


def test_afit_says_what_the_thesis_says() -> None:
    loaded = scene.load("afit_simsat")
    # Reference §1.1: apex 48 in, semi-axes 38.88 and 28.60 in, pitch 8 mm, tilt +-30 deg, 35 mm, 1600 x 1200.
    assert loaded.light.surface.apex_m == pytest.approx(48 * 0.0254, abs=1e-12)
    assert loaded.light.surface.semi_axes_m == pytest.approx((0.987552, 0.987552, 0.72644), abs=1e-12)
    assert loaded.light.layout.pitch_m == pytest.approx(0.008, abs=1e-15)
    assert loaded.vehicle.tilt_stop_deg == 30
    assert (loaded.camera.width_px, loaded.camera.height_px) == (1600, 1200)
    # Focused at 33 in: the chip is 36.53 mm from the lens (§1.2).
    assert loaded.camera.focal_px == pytest.approx(1 / (1 / 0.035 - 1 / 0.8382) / 4e-6, rel=1e-12)
    assert loaded.camera.image_distance_m == pytest.approx(36.53e-3, abs=5e-6)
    assert (loaded.name, loaded.seed) == ("afit_simsat", 1)
    assert loaded.start_time == datetime.datetime(2012, 3, 1, 12)


def test_a_scene_is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        scene.load("shefex2").seed = 3


def test_a_scene_is_found_by_name_and_by_path() -> None:
    assert scene.load("shefex2") == scene.load(SHEFEX) == scene.load(str(SHEFEX))


def test_the_camera_of_a_scene_can_be_read_alone(tmp_path: Path) -> None:
    text = SHEFEX.read_text()
    alone = tmp_path / "camera.yaml"
    alone.write_text(text[text.index("camera:") : text.index("exposure:")])
    assert scene.load_camera(alone) == scene.load_camera(SHEFEX) == scene.load("shefex2").camera


# Overrides


def test_an_override_takes_the_place_of_the_file_s_value() -> None:
    changed = scene.load("afit_simsat", {"camera.detector.bits": "8", "motion.start": "{yaw_deg: 40}"})
    assert changed.camera.detector.bits == 8
    assert changed.motion.start == scene.Attitude(yaw_deg=40)


def test_an_override_may_add_a_section() -> None:
    text = {"tracker.believed_camera_body": "['1 in', '0 m', '15 in']"}
    assert scene.load("afit_simsat", text).tracker.believed_camera_body_m == pytest.approx((0.0254, 0, 0.381))


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
            "exposure.time: '-1 ms' is not allowed; it should be greater than or equal to 0.000001 (--set)",
        ),
        (
            "exposure.frames",
            "0",
            "exposure.frames: 0 is not allowed; it should be greater than or equal to 1",
        ),
        ("seed.x", "3", "--set seed.x: seed holds a value, not keys"),
        ("seed", "[", "--set seed: '[' is not YAML"),
        ("camera..bits", "3", "--set camera..bits=3: allowed: path.to.key=value"),
        ("camera", "", "camera: None is not allowed; it should be a mapping of keys to values (--set)"),
        ("exposure.time", "a\nb", "is not a time; allowed: a time such as"),
    ],
)
def test_a_bad_override_is_one_line_and_blamed_on_the_option(key: str, value: str, says: str) -> None:
    message = complaint(SHEFEX, {key: value})
    assert says in message
    assert "--set" in message
    assert str(SHEFEX) not in message


# Slips in a file


@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        ("falloff: inverse_square", "falloff: cubic", "light.led.falloff: 'cubic' is none of inverse_square"),
        ("  kind: dome", "  kind: domes", "light.kind: 'domes' is none of dome, stars"),
        (
            "kind: ellipsoid",
            "kind: torus",
            "light.surface.kind: 'torus' is not allowed; it should be 'sphere', ",
        ),
        (
            "control: pid",
            "control: lqr",
            "motion.control: 'lqr' is not allowed; it should be 'none' or 'pid'",
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
            "light.surface.apex: '-48 in' is not allowed; it should be greater than",
        ),
        (
            '"38.88 in", "28.60 in"]',
            '"38.88 in", "0 in"]',
            "light.surface.semi_axes.2: '0 in' is not allowed",
        ),
        (
            'time: "10 ms"',
            'time: "-10 ms"',
            "exposure.time: '-10 ms' is not allowed; it should be greater than or equal to 0.000001",
        ),
        ('time: "10 ms"', 'time: "nan ms"', "exposure.time: nan is not a finite number"),
        ('time: "10 ms"', 'time: "1e400 ms"', "exposure.time: inf is not a finite number"),
        ("f_number: 8", "f_number: .nan", "camera.f_number: nan is not a finite number"),
        (
            "preset: lu205c",
            "width_px: 1600.5\n  preset: lu205c",
            "camera.width_px: 1600.5 is not allowed; it should be a valid integer",
        ),
        (
            "preset: lu205c",
            "detector: {bits: 17}\n  preset: lu205c",
            "camera.detector.bits: 17 is not allowed; it should be less than or equal to 16",
        ),
        ("lit: [3, 6]", "lit: [3, 12]", "allowed: 1 <= least <= most <= 9"),
        ("lit: [3, 6]", "lit: [3]", "light.layout.lit.1: missing"),
        ("pwm_levels: [1.0, 0.7, 0.5, 0.35]", "pwm_levels: []", "light.layout.pwm_levels: [] is not allowed"),
        ("hardware_seed: 2012", "hardware_seed: -1", "light.layout.hardware_seed: -1 is not allowed"),
        ('"9.0 kg m2"', '"90 kg m2"', "is no rigid body's: each positive, none above the sum of the others"),
        ("schema: 1", "schema: 2", "schema: 2 is not allowed; it should be 1"),
        ("seed: 1\n", "seed: one\n", "seed: 'one' is not allowed; it should be a valid integer"),
        (
            "2012-03-01T12:00:00",
            "yesterday",
            "start_time: 'yesterday' is not allowed; it should be a valid datetime",
        ),
        ("title: AFIT", "name: x\ntitle: AFIT", "name: unknown key"),
        (
            'duration: "1 s"',
            'durations: "1 s"',
            "unknown key; did you mean duration?; allowed: kind, duration",
        ),
        ('{kind: hold, duration: "1 s"}', '{kind: wait, duration: "1 s"}', "'wait' is none of hold, slew"),
        (
            "pitch_deg: 0",
            "pich_deg: 0",
            "motion.start.pich_deg: unknown key; did you mean pitch_deg?; allowed: roll_",
        ),
    ],
)
def test_a_slip_is_answered_with_its_key_what_is_allowed_and_its_line(
    tmp_path: Path, right: str, wrong: str, says: str
) -> None:
    message, place = spoilt(tmp_path, AFIT, right, wrong)
    assert says in message
    assert message.endswith(place)


@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        (
            "ra_deg: 83.0",
            "ra_deg: 400",
            "motion.start.ra_deg: 400 is not allowed; it should be less than 360",
        ),
        (
            "dec_deg: 2.0",
            "dec_deg: -91",
            "motion.start.dec_deg: -91 is not allowed; it should be greater than",
        ),
        ("ra_deg: 83.0", "ra_deg: .nan", "motion.start.ra_deg: nan is not a finite number"),
        (
            "dec_deg: 2.0",
            "decl_deg: 2.0",
            "motion.start.decl_deg: unknown key; did you mean dec_deg?; allowed: ra_deg",
        ),
        ("dec_deg: 2.0, roll_deg: 20.0", "roll_deg: 20.0", "motion.start.dec_deg: missing"),
        (
            "ra_deg: 83.0, dec_deg: 2.0, ",
            "",
            "motion.start: light of kind stars takes ra_deg, dec_deg, roll_deg",
        ),
    ],
)
def test_a_slip_in_where_the_camera_points_is_not_taken_for_a_vehicle_s(
    tmp_path: Path, right: str, wrong: str, says: str
) -> None:
    message, place = spoilt(tmp_path, SHEFEX, right, wrong)
    assert says in message
    assert message.endswith(place)


def test_a_dome_cannot_start_at_a_place_in_the_sky(tmp_path: Path) -> None:
    right = "start: {roll_deg: 0, pitch_deg: 0, yaw_deg: 0}"
    message, place = spoilt(tmp_path, AFIT, right, "start: {ra_deg: 83, dec_deg: 2}")
    assert message == f"motion.start: light of kind dome takes roll_deg, pitch_deg, yaw_deg {place}"


# Unions: of each the allowed kinds, as a wrong one is answered

UNIONS = [
    ("kind: gaussian", "kind: gauss", "camera.psf.kind", "gaussian, moffat, airy, disc, measured"),
    ("kind: global", "kind: shut", "camera.shutter.kind", "global, rolling, frame_transfer, interline"),
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
        "uniform, sky, moon, stray",
    ),
    ("control: pid", "jitter: [{kind: white}]\n  control: pid", "motion.jitter.0.kind", "line, band"),
    (
        "preset: lu205c",
        "preset: lu206c",
        "camera.preset",
        "aps, ec655, lu205c, wat902h2",
    ),
]


@pytest.mark.parametrize(("right", "wrong", "key", "allowed"), UNIONS)
def test_a_kind_that_is_none_is_answered_with_those_that_are(
    tmp_path: Path, right: str, wrong: str, key: str, allowed: str
) -> None:
    message, place = spoilt(tmp_path, AFIT, right, wrong)
    assert re.fullmatch(rf"{re.escape(key)}: '\w+' is none of {allowed} {re.escape(place)}", message)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("camera.psf", "{kind: moffat}", "camera.psf.fwhm_px: missing"),
        ("camera.psf", "{kind: disc, radius_px: 0}", "camera.psf.radius_px: 0 is not allowed"),
        ("camera.psf", "{sigma_px: 0.5, fwhm_px: 2}", "camera.psf: kind is missing"),
        ("camera.psf", "{kind: airy, wavelength: 550}", "camera.psf.wavelength: 550 has no unit"),
        ("camera.shutter", "{kind: frame_transfer}", "camera.shutter.row_time: missing"),
        (
            "camera.shutter",
            "{kind: rolling, row_time: 1 ms}",
            "camera.shutter: reading takes 1.199 s, longer than the frame period 0.5 s",
        ),
        ("light.led.intensity", "null", "light.led: an LED takes either intensity or radiant_intensity"),
        ("light.led.radiant_intensity", "3 mW/sr", "light.led: an LED takes either intensity or radiant_"),
        (
            "light.led.lobe",
            "{kind: table, angle_deg: [0, 60], intensity: [20, 1]}",
            "light.led.lobe: the table does not begin with an intensity of 1 at 0 deg",
        ),
        ("camera.shutter", "{kind: global, row_time: '3 us'}", "camera.shutter.row_time: unknown key"),
        ("camera.vignetting", "{kind: two_stops, cutoff_deg: 90}", "camera.vignetting.cutoff_deg: 90 is not"),
        (
            "camera.vignetting",
            "{kind: two_stops, cutof_deg: 9}",
            "camera.vignetting.cutof_deg: unknown key; did you mean cutoff_deg?",
        ),
        (
            "camera.vignetting",
            "{kind: table, angle_deg: [0, 5, 5], transmission: [1, 1, 1]}",
            "camera.vignetting: angle_deg does not ascend",
        ),
        (
            "light.led.lobe",
            "{kind: table, angle_deg: [0, 5, 9], intensity: [1, 1]}",
            "light.led.lobe: angle_deg has 3 numbers, intensity 2",
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
        ("camera.detector.quantum_efficiency", "ccd", "'ccd' is none of cmos, interline, thick_ccd"),
        ("camera.detector.offset_dn", "1024", "offset_dn 1024 is beyond a converter of 10 bits"),
    ],
)
def test_a_slip_within_a_kind_is_told_of_that_kind_alone(key: str, value: str, says: str) -> None:
    message = complaint(AFIT, {key: value})
    assert says in message
    assert "tagged-union" not in message


# The camera: preset and focus


def test_what_the_scene_says_stands_above_its_camera_s_preset(tmp_path: Path) -> None:
    """Keys of a section are merged; a section of another kind replaces the preset's."""
    path = tmp_path / "mine.yaml"
    path.write_text(
        SHEFEX.read_text().replace(
            "preset: ec655",
            "preset: ec655\n  width_px: 640\n  detector: {read_noise_e: 9}\n  shutter: {kind: global}",
        )
    )
    plain, mine = scene.load("shefex2").camera, scene.load(path).camera
    assert (mine.width_px, mine.detector.read_noise_e, mine.shutter.kind) == (640, 9.0, "global")
    assert (plain.width_px, plain.detector.read_noise_e, plain.shutter.kind) == (659, 14.7, "interline")
    changed = {"width_px": 640, "shutter": mine.shutter, "detector": mine.detector}
    assert mine == plain.model_copy(update=changed)
    assert mine.detector == plain.detector.model_copy(update={"read_noise_e": 9.0})
    assert scene.load_camera(path) == mine


def test_an_override_stands_above_the_preset() -> None:
    assert scene.load("shefex2", {"camera.detector.bits": "8"}).camera.detector.bits == 8
    other = scene.load("shefex2", {"camera.preset": "aps"}).camera
    assert (other.width_px, other.shutter.kind, other.focal_length_m) == (1024, "rolling", 0.025)


def test_a_lens_is_focused_at_infinity_unless_told_otherwise() -> None:
    lens = scene.load("shefex2").camera
    assert lens.focus_m == math.inf
    assert lens.image_distance_m == pytest.approx(0.025, rel=1e-15)


@pytest.mark.parametrize("focus", ["70 mm", "35 mm", "1 um"])
def test_a_focus_nearer_than_twice_the_focal_length_is_refused(tmp_path: Path, focus: str) -> None:
    """There the image would be greater than the object; at the focal length there is none at all."""
    message, _ = spoilt(tmp_path, AFIT, 'focus: "33 in"', f'focus: "{focus}"')
    assert re.match(r"camera: focus \S+ m is nearer than twice the focal length 0.035 m \(", message)


@pytest.mark.parametrize(
    ("focus", "says"),
    [
        ("0 m", "camera.focus: '0 m' is not allowed; it should be greater than 0"),
        ("-33 in", "camera.focus: '-33 in' is not allowed; it should be greater than 0"),
        ("nan m", "camera.focus: 'nan m' is not allowed"),
        ("far", "camera.focus: 'far' is not a length; allowed: a length such as \"33 in\", or infinity"),
        ("33", 'camera.focus: 33 has no unit; allowed: a length such as "33 in", or infinity'),
    ],
)
def test_a_focus_that_is_no_distance_is_refused(focus: str, says: str) -> None:
    assert says in complaint(AFIT, {"camera.focus": focus})


def test_a_missing_key_is_named_with_its_section_s_line(tmp_path: Path) -> None:
    message, _ = spoilt(tmp_path, AFIT, '    apex: "48 in"\n', "")
    line = line_number(AFIT.read_text(), "surface:")
    assert message == f"light.surface.apex: missing ({tmp_path / 'bad.yaml'}, line {line})"


def test_a_missing_section_is_named(tmp_path: Path) -> None:
    message, _ = spoilt(tmp_path, AFIT, "seed: 1\n", "")
    assert message == f"seed: missing ({tmp_path / 'bad.yaml'})"


def test_an_exposure_longer_than_its_period_is_refused(tmp_path: Path) -> None:
    message, place = spoilt(tmp_path, AFIT, 'time: "10 ms"', 'time: "10 s"')
    assert message == f"exposure: time 10.0 s is longer than the frame period 0.5 s {place}"


def test_a_manoeuvre_without_a_controller_is_refused(tmp_path: Path) -> None:
    message, _ = spoilt(tmp_path, AFIT, "control: pid", "control: none")
    assert message.startswith("motion: a manoeuvre needs a controller; allowed: control: pid")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [1, 2", "not YAML"),
        ("a:\n\t- b", "line 2: not YAML"),
        ("a: \x00", "not YAML: unacceptable character"),
        ("", "allowed: a mapping of keys to values"),
        ("- 1\n- 2\n", "allowed: a mapping of keys to values"),
        ("just words", "allowed: a mapping of keys to values"),
        ("1: 2\n", "1: 1 is not allowed"),
    ],
)
def test_what_is_no_scene_at_all_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    message = complaint(path)
    assert says in message
    assert str(path) in message


def test_bytes_that_are_no_text_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(b"\xff\xfe\x80\x81")
    assert f"{path}: cannot be read" in complaint(path)


@pytest.mark.parametrize("name", ["nosuch", "nosuch.yaml", "scenes/nosuch", "", "."])
def test_an_unknown_scene_is_answered_with_the_known_ones(name: str) -> None:
    with pytest.raises(
        BadInput, match=r"no such scene; allowed: a \.yaml file or one of .*afit_simsat.*shefex2"
    ):
        scene.load(name)


def test_a_camera_file_without_a_camera_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("title: no camera\n")
    with pytest.raises(BadInput, match=r"^camera: missing \(.*camera\.yaml\)$"):
        scene.load_camera(path)


def kinds(union: object) -> set[str]:
    """The kinds of a discriminated union."""
    return {get_args(part.model_fields["kind"].annotation)[0] for part in get_args(get_args(union)[0])}


def test_every_algorithm_that_the_schema_names_exists() -> None:
    assert set(light.Surface.model_fields["kind"].annotation.__args__) == set(SURFACES)
    assert set(light.PatchBoards.model_fields["kind"].annotation.__args__) == set(LAYOUTS)
    assert kinds(camera.Psf) == set(PSFS)
    assert kinds(get_args(camera.Camera.model_fields["vignetting"].annotation)[0]) == set(VIGNETTING)
    assert kinds(light.Lobe) == set(LOBES)
    assert kinds(light.Glow) == set(BACKGROUNDS)
    assert kinds(scene.Jitter) == set(SPECTRA)


def test_a_key_that_stands_twice_is_refused(tmp_path):
    """YAML itself would take the last one without a word."""
    path = tmp_path / "twice.yaml"
    path.write_text((scene.SCENES / "shefex2.yaml").read_text() + "\nseed: 3\n")
    with pytest.raises(BadInput, match=r"^seed: stands twice in one section \(.*twice.yaml, line \d+\)$"):
        scene.load(path)
