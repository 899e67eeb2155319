"""Attitude profiles: every format and column name gives the intended motion or one error line."""

from __future__ import annotations

import datetime
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from skysim.core import text
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.dynamics.guidance import plan, profile_start
from skysim.dynamics.profile_samples import MAX_SAMPLES, Samples, check_samples
from skysim.dynamics.profiles import read_profile
from skysim.dynamics.reference_curves import AttitudeSpline
from skysim.results.files import run_export
from skysim.scene.sections.motion import MotionConfig, ProfileConfig
from skysim.sources.stars import cam_from_icrs

START = datetime.datetime(2016, 12, 31, 12, 0, 0)
TIMES = np.arange(0.0, 6.05, 0.1)


def tumble(t_s: np.ndarray) -> Rotation:
    """A tumble by up to 13 deg/s, with acceleration at both ends."""
    yaw = 40 * np.sin(0.3 * t_s + 0.3) + 3 * t_s
    pitch = 20 * np.cos(0.5 * t_s)
    roll = 15 * np.sin(0.7 * t_s + 1)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]), degrees=True)


def sampled(t_s: np.ndarray = TIMES) -> Samples:
    return Samples("it", "row", np.arange(1, len(t_s) + 1), t_s, "lab", "body", tumble(t_s))


def angle(a: Rotation, b: Rotation) -> np.ndarray:
    return np.linalg.norm((a.inv() * b).as_rotvec(), axis=-1)


# --- the spline ---------------------------------------------------------------------------------------------


def attitudes(spline, t_s: np.ndarray) -> Rotation:
    return Rotation.from_quat(spline.states_at(t_s)[0], scalar_first=True)


@pytest.mark.compiles
def test_the_spline_goes_through_its_samples_with_a_unit_quaternion() -> None:
    spline = AttitudeSpline(sampled())
    assert angle(attitudes(spline, TIMES), tumble(TIMES)).max() < 1e-14
    between = np.linspace(-0.1, 6.2, 200)
    np.testing.assert_allclose(
        np.linalg.norm(spline.states_at(between)[0], axis=1), 1, rtol=0, atol=1e-15
    )


@pytest.mark.compiles
def test_rate_and_acceleration_are_the_derivatives_of_the_attitude() -> None:
    """Central differences within the steps, the continued ends included: off by their own h^2 and by rounding / h."""
    spline = AttitudeSpline(sampled())
    h = 1e-4
    t = np.concatenate([TIMES[:-1] + 0.037, [-0.05, 6.05]])
    _, rate, acceleration = spline.states_at(t)
    before = spline.states_at(t - h)
    after = spline.states_at(t + h)
    turned = (
        Rotation.from_quat(before[0], scalar_first=True).inv() * attitudes(spline, t + h)
    ).as_rotvec() / (2 * h)
    np.testing.assert_allclose(turned, rate, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        (after[1] - before[1]) / (2 * h), acceleration, rtol=0, atol=1e-7
    )


@pytest.mark.compiles
def test_rate_and_acceleration_are_continuous_at_every_sample() -> None:
    spline = AttitudeSpline(sampled())
    eps = 1e-9
    before = spline.states_at(TIMES[1:-1] - eps)
    after = spline.states_at(TIMES[1:-1] + eps)
    np.testing.assert_allclose(before[1], after[1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(before[2], after[2], rtol=0, atol=1e-8)
    jerk = np.diff(spline.states_at(TIMES)[2], axis=0) / 0.1
    # The next derivative does jump, so the test can fail.
    assert np.abs(np.diff(jerk, axis=0)).max() > 1e-3


@pytest.mark.compiles
def test_the_error_is_of_fourth_order_up_to_both_ends() -> None:
    """Half the step, a sixteenth of the error: within and in the first and last step alike."""
    t = np.linspace(0, 6, 4001)
    ends = (t < 0.2) | (t > 5.8)
    errors = []
    for step_s in (0.1, 0.05):
        error = angle(
            attitudes(AttitudeSpline(sampled(np.arange(0, 6 + step_s / 2, step_s))), t),
            tumble(t),
        )
        errors.append([error.max(), error[ends].max()])
    assert np.array(errors[0]) / errors[1] == pytest.approx([16, 16], rel=0.2)
    assert errors[0][0] < 0.05 * ARCSEC_RAD


def test_the_spline_beats_that_of_rotation_vectors_at_the_ends() -> None:
    """SciPy's RotationSpline is clamped to the mean rate of the outer steps."""
    t = np.linspace(0, 6, 4001)
    ours = angle(attitudes(AttitudeSpline(sampled()), t), tumble(t)).max()
    theirs = angle(RotationSpline(TIMES, tumble(TIMES))(t), tumble(t)).max()
    assert ours < 0.01 * theirs
    middle = (t > 2) & (t < 4)
    np.testing.assert_allclose(
        angle(
            attitudes(AttitudeSpline(sampled()), t[middle]),
            RotationSpline(TIMES, tumble(TIMES))(t[middle]),
        ),
        0,
        atol=3e-7,
    )


def test_a_quaternion_and_its_negative_are_the_same_attitude() -> None:
    """The file may change the sign at any sample."""
    flipped = tumble(TIMES).as_quat() * np.where(np.arange(len(TIMES)) % 3, 1, -1)[:, None]
    columns = {"t_s": TIMES} | {
        f"lab_from_body_q{end}": flipped[:, n] for n, end in enumerate("xyzw")
    }
    spline = AttitudeSpline(read_profile(columns, START))
    t = np.linspace(0, 6, 500)
    assert angle(attitudes(spline, t), attitudes(AttitudeSpline(sampled()), t)).max() < 1e-14


def test_at_a_constant_rate_the_error_falls_with_the_fifth_power_of_the_step() -> None:
    """By 0.04 arcsec at the largest step that is allowed, 10 deg: of fourth order it errs only along the quaternion."""
    errors = []
    for step_deg in (9.99, 9.99 / 2):
        rate = np.radians(step_deg) * np.array([0.6, 0, 0.8])
        t = np.arange(0.0, 20.0)
        spin = Rotation.from_rotvec(np.outer(t, rate))
        spline = AttitudeSpline(
            check_samples(Samples("it", "row", np.arange(20), t, "lab", "body", spin))
        )
        between = np.linspace(0, 19, 4001)
        errors.append(
            angle(
                attitudes(spline, between), Rotation.from_rotvec(np.outer(between, rate))
            ).max()
        )
    assert errors[0] / ARCSEC_RAD == pytest.approx(0.04, abs=0.005)
    assert errors[0] / errors[1] == pytest.approx(32, rel=0.05)


# --- tables -------------------------------------------------------------------------------------------------


def csv(path: Path, columns: dict[str, object]) -> Path:
    rows = zip(*(values for values in columns.values()), strict=True)  # type: ignore[call-overload]
    lines = [
        ", ".join(columns),
        "# a comment",
        *(",".join(str(cell) for cell in row) for row in rows),
        "",
    ]
    path.write_text("\n".join(lines))
    return path


def quaternion_columns(
    name: str, rotation: Rotation, order: str = "wxyz"
) -> dict[str, object]:
    xyzw = rotation.as_quat()
    return {"t_s": TIMES} | {f"{name}{end}": xyzw[:, "xyzw".index(end)] for end in order}


def angles_columns() -> dict[str, object]:
    yaw, pitch, roll = tumble(TIMES).as_euler("ZYX", degrees=True).T
    return {"t_s": TIMES, "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}


MOTION = tumble(TIMES)
TABLES = {
    "scalar first": (quaternion_columns("lab_from_body_q", MOTION), None),
    "scalar last": (quaternion_columns("lab_from_body_q", MOTION, "xyzw"), None),
    "any order": (quaternion_columns("lab_from_body_q", MOTION, "zwyx"), None),
    "inverse": (quaternion_columns("body_from_lab_q", MOTION.inv()), None),
    "frames given": (quaternion_columns("q_", MOTION, "xyzw"), "lab_from_body"),
    "frames given, inverse": (
        quaternion_columns("q_", MOTION.inv(), "wxyz"),
        "body_from_lab",
    ),
    "angles": (angles_columns(), None),
}


@pytest.mark.parametrize("name", TABLES)
def test_column_names_give_order_and_direction(name: str, tmp_path: Path) -> None:
    columns, rotation = TABLES[name]
    for source in (csv(tmp_path / "p.csv", columns), columns):
        read = read_profile(source, START, rotation)
        read = read if read.a == "lab" else read.inverted()
        assert (read.direction, read.absolute) == ("lab_from_body", False)
        np.testing.assert_array_equal(read.t_s, TIMES)
        assert angle(read.a_from_b, MOTION).max() < 1e-14


@pytest.mark.parametrize(
    "name", ["icrs_from_cam", "cam_from_icrs", "icrs_from_body", "body_from_icrs"]
)
def test_columns_of_the_sky_name_both_frames(name: str) -> None:
    read = read_profile(quaternion_columns(f"{name}_q", MOTION), START)
    assert read.direction == name
    assert angle(read.a_from_b, MOTION).max() < 1e-15


def test_right_ascension_declination_and_roll_are_the_camera_s() -> None:
    ra = 80 + TIMES
    dec = 89.5 - TIMES / 10
    roll = -170 - 3 * TIMES
    read = read_profile({"t_s": TIMES, "ra_deg": ra, "dec_deg": dec, "roll_deg": roll}, START)
    expected = Rotation.concatenate(
        [cam_from_icrs(*row) for row in np.column_stack([ra, dec, roll])]
    )
    assert read.direction == "cam_from_icrs"
    assert angle(read.a_from_b, expected).max() < 1e-14


def test_tables_of_astropy_and_pandas_are_read_with_their_dates(tmp_path: Path) -> None:
    import pandas as pd
    from astropy.table import Table
    from astropy.time import Time

    moments = [START + datetime.timedelta(seconds=60 + float(t)) for t in TIMES]
    angles = {name: column for name, column in angles_columns().items() if name != "t_s"}
    with_units = Table(
        angles_columns(),
        units={"t_s": "s", "roll_deg": "deg", "pitch_deg": "deg", "yaw_deg": "deg"},
    )
    with_units.write(tmp_path / "p.ecsv", format="ascii.ecsv")
    dated = [
        pd.DataFrame({"utc": pd.to_datetime(moments)} | angles),
        Table({"utc": Time(moments, scale="utc")} | angles),
        Table({"utc": [moment.isoformat() for moment in moments]} | angles),
        csv(
            tmp_path / "p.csv",
            {"utc": [f"{moment.isoformat()}Z" for moment in moments]} | angles,
        ),
    ]
    for source in dated:
        read = read_profile(source, START)
        assert read.absolute
        np.testing.assert_allclose(read.t_s, 60 + TIMES, rtol=0, atol=2e-9)
        assert angle(read.a_from_b, MOTION).max() < 1e-14
    for source in (with_units, pd.DataFrame(angles_columns()), tmp_path / "p.ecsv"):
        read = read_profile(source, START)
        np.testing.assert_array_equal(read.t_s, TIMES)
        assert angle(read.a_from_b, MOTION).max() < 1e-14
    with_units["yaw_deg"].unit = "rad"
    with pytest.raises(InputError, match="profile: column yaw_deg is in rad; allowed: deg"):
        read_profile(with_units, START)


GOOD = "t_s,roll_deg,pitch_deg,yaw_deg\n0,0,0,0\n1,1,0,0\n2,2,0,0\n3,3,0,0\n"
FAULTY_TABLES = [
    (
        GOOD.replace("roll_deg", "roll"),
        r"line 1: unknown column 'roll'; allowed: t_s or utc, with A_from_B_qx",
    ),
    (GOOD.replace("t_s", "t"), r"line 1: unknown column 't'"),
    (GOOD.replace("t_s", "yaw_deg"), r"line 1: two columns 'yaw_deg'"),
    (
        GOOD.replace(",yaw_deg", ""),
        r"columns t_s, roll_deg, pitch_deg are not one time and one attitude",
    ),
    (GOOD.replace("t_s,", "utc,t_s,"), r"columns utc, t_s, .* are not one time"),
    (
        "t_s,q_x,q_y,q_z,q_w\n",
        r"line 1: q_x, q_y, q_z, q_w do not say which rotation they are",
    ),
    ("t_s,q1,q2,q3,q4\n", r"line 1: unknown column 'q1'"),
    ("# nothing\n\n", r"empty; allowed: a line of column names"),
    (GOOD.replace("1,1,0,0", "1,1,0"), r"line 3: 3 values; allowed: 4"),
    (GOOD.replace("2,2,0,0", "2,2,0,zero"), r"line 4: 'zero' is not a number"),
    (GOOD.replace("2,2,0,0", "2,2,0,nan"), r"line 4: 'nan' is not a finite number"),
    (
        GOOD.replace("3,3,0,0", "2,3,0,0"),
        r"line 5: time 2 s is not after 2 s, by a microsecond at least",
    ),
    (
        GOOD.replace("3,3,0,0", "3e9,3,0,0"),
        r"line 5: time 3e\+09 s; allowed: within 1e\+09 s of the start",
    ),
    (
        GOOD.replace("3,3,0,0", "3,30,0,0"),
        r"line 5: 28 deg from the attitude before it; allowed: up to 10 deg",
    ),
    (GOOD.replace("3,3,0,0\n", ""), r"3 attitudes; allowed: 4 to 1000000"),
    (
        "t_s,lab_from_body_qw,lab_from_body_qx,lab_from_body_qy,lab_from_body_qz\n"
        + "0,1,0,0,0\n1,1.002,0,0,0\n",
        r"line 3: a quaternion of norm 1.002; allowed: 1, to 0.001",
    ),
    (
        "utc,roll_deg,pitch_deg,yaw_deg\nnoon,0,0,0\n",
        r"line 2: 'noon' is not an epoch; allowed: 2012-06-22T21:00:00.5",
    ),
    (
        "utc,roll_deg,pitch_deg,yaw_deg\n2012-13-40T00:00:00,0,0,0\n",
        r"line 2: .* is not a date and time",
    ),
    ("t_s,ra_deg,dec_deg,roll_deg\n0,1,91,0\n", r"line 2: dec_deg is beyond a pole"),
    ("<?xml version='1.0'?>", r"XML; allowed: CSV, ECSV, CCSDS AEM"),
]


@pytest.mark.parametrize(("content", "message"), FAULTY_TABLES)
def test_an_error_in_a_table_is_reported_with_its_line(
    content: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "p.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as raised:
        check_samples(read_profile(path, START))
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_the_table_without_faults_is_read(tmp_path: Path) -> None:
    """Without a fault the same table is read, so each fault above is the cause of its refusal."""
    (tmp_path / "p.csv").write_text(GOOD)
    assert len(check_samples(read_profile(tmp_path / "p.csv", START)).t_s) == 4


def test_a_file_too_large_or_no_text_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        read_profile(path, START)
    path.write_text(GOOD)
    monkeypatch.setattr(text, "MAX_BYTES", 20)
    with pytest.raises(InputError, match=r"bytes; allowed: up to 20"):
        read_profile(path, START)
    t = np.arange(MAX_SAMPLES + 1.0)
    many = Samples(
        "it",
        "row",
        t.astype(int),
        t,
        "lab",
        "body",
        Rotation.from_rotvec(np.zeros((len(t), 3))),
    )
    with pytest.raises(InputError, match="1000001 attitudes; allowed: 4 to 1000000"):
        check_samples(many)


@pytest.mark.parametrize(
    "table", [3, "text", [1, 2], {"t_s": [0, 1], "roll_deg": ["a", "b"]}, {"t_s": [[1], [2]]}]
)
def test_an_object_that_is_not_a_table_is_refused(table: object) -> None:
    with pytest.raises(InputError, match=r"^profile"):
        read_profile(table, START)


def test_columns_of_different_lengths_are_refused() -> None:
    columns = angles_columns() | {"yaw_deg": np.zeros(3)}
    with pytest.raises(
        InputError, match="profile: column yaw_deg has 3 values; allowed: 61, as the first"
    ):
        read_profile(columns, START)


# --- CCSDS AEM ----------------------------------------------------------------------------------------------

META = {
    "OBJECT_NAME": "X",
    "OBJECT_ID": "X",
    "REF_FRAME_A": "ICRF",
    "REF_FRAME_B": "SC_BODY_1",
    "ATTITUDE_DIR": "A2B",
    "TIME_SYSTEM": "UTC",
    "START_TIME": "2016-12-31T12:00:00",
    "STOP_TIME": "2016-12-31T12:01:00",
    "ATTITUDE_TYPE": "QUATERNION",
    "QUATERNION_TYPE": "LAST",
}


def segment(
    rotations: Rotation,
    t_s: np.ndarray,
    more: str = "",
    scalar_first: bool = False,
    **meta: str,
) -> str:
    rows = rotations.as_quat(scalar_first=scalar_first)
    lines = [f"{key} = {value}" for key, value in (META | meta).items() if value]
    data = [
        f"{(START + datetime.timedelta(seconds=float(t))).isoformat()} {' '.join(map(repr, row.tolist()))}{more}"
        for t, row in zip(t_s, rows, strict=True)
    ]
    return "\n".join(
        [
            "META_START",
            "COMMENT a = b",
            *lines,
            "META_STOP",
            "",
            "DATA_START",
            *data,
            "DATA_STOP",
            "",
        ]
    )


def aem(*segments: str, version: str = "1.0") -> str:
    return (
        f"COMMENT first\nCCSDS_AEM_VERS = {version}\nCREATION_DATE = 2017-01-01T00:00:00\nORIGINATOR = US\n\n"
        + "".join(segments)
    )


def read_text(content: str, tmp_path: Path, name: str = "p.aem") -> Samples:
    (tmp_path / name).write_text(content)
    return read_profile(tmp_path / name, START)


@pytest.mark.parametrize("frames", [("ICRF", "STARTRACKER_1"), ("LAB", "SC_BODY_1")])
def test_a_written_profile_is_read_unchanged(frames: tuple[str, str], tmp_path: Path) -> None:
    utc = [START + datetime.timedelta(seconds=float(t)) for t in TIMES + 1.5]
    read = read_text(run_export.message("x", ["COMMENT"], frames, utc, MOTION), tmp_path)
    assert read.direction == {"ICRF": "icrs_from_cam", "LAB": "lab_from_body"}[frames[0]]
    assert read.absolute
    np.testing.assert_allclose(read.t_s, TIMES + 1.5, rtol=0, atol=1e-9)
    assert angle(read.a_from_b, MOTION).max() < 1e-14


@pytest.mark.parametrize("order", ["FIRST", "LAST"])
@pytest.mark.parametrize("direction", ["A2B", "B2A"])
@pytest.mark.parametrize("reference_first", [True, False])
@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("QUATERNION", ""),
        ("QUATERNION/RATE", " 1 2 3"),
        ("QUATERNION/DERIVATIVE", " 0 0 0 0"),
    ],
)
def test_order_direction_and_frames_of_version_1(
    order: str, direction: str, reference_first: bool, kind: str, more: str, tmp_path: Path
) -> None:
    """The quaternion from A to B is that of a_from_b, whose inverse is from B to A. MOTION is icrs_from_body here."""
    a_from_b = MOTION if reference_first else MOTION.inv()
    rotations = a_from_b if direction == "A2B" else a_from_b.inv()
    frames = ("ICRF", "SC_BODY_1") if reference_first else ("SC_BODY_1", "ICRF")
    part = segment(
        rotations,
        TIMES,
        more,
        order == "FIRST",
        REF_FRAME_A=frames[0],
        REF_FRAME_B=frames[1],
        ATTITUDE_DIR=direction,
        QUATERNION_TYPE=order,
        ATTITUDE_TYPE=kind,
    )
    read = read_text(aem(part), tmp_path)
    read = read if read.a == "icrs" else read.inverted()
    assert read.direction == "icrs_from_body"
    assert angle(read.a_from_b, MOTION).max() < 1e-14


def test_version_2_is_from_a_to_b_scalar_last(tmp_path: Path) -> None:
    part = segment(
        MOTION,
        TIMES,
        " 0 0 0",
        ATTITUDE_DIR="",
        QUATERNION_TYPE="",
        ATTITUDE_TYPE="QUATERNION/ANGVEL",
    )
    assert angle(read_text(aem(part, version="2.0"), tmp_path).a_from_b, MOTION).max() < 1e-14


def test_the_aem_standard_s_example_is_read(tmp_path: Path) -> None:
    """CCSDS 504.0-B-1, figure 4-1, its useable span without the first line; EME2000 is turned by the frame bias."""
    rows = [
        "21:29:07.2555 0.56748 0.03146 0.45689 0.68427",
        "22:08:03.5555 0.42319 -0.45697 0.23784 0.74533",
    ]
    rows += ["22:08:04.5555 -0.84532 0.26974 -0.06532 0.45652"]
    meta = META | {
        "REF_FRAME_A": "EME2000",
        "CENTER_NAME": "mars barycenter",
        "INTERPOLATION_METHOD": "hermite",
    }
    meta |= {
        "USEABLE_START_TIME": "1996-11-28T22:08:02.5555",
        "USEABLE_STOP_TIME": "1996-11-30T01:18:02.5555",
    }
    lines = [f"{key} = {value}" for key, value in meta.items()]
    data = [f"1996-11-28T{row}" for row in rows]
    content = aem(
        "\n".join(["META_START", *lines, "META_STOP", "DATA_START", *data, "DATA_STOP"])
    )
    (tmp_path / "p.aem").write_text(content)
    read = read_profile(tmp_path / "p.aem", datetime.datetime(1996, 11, 28, 22, 8, 0))
    np.testing.assert_allclose(read.t_s, [3.5555, 4.5555], rtol=0, atol=1e-9)
    there = Rotation.from_quat(
        [[0.42319, -0.45697, 0.23784, 0.74533], [-0.84532, 0.26974, -0.06532, 0.45652]]
    )
    assert angle(read.a_from_b, there).max() == pytest.approx(23e-3 * ARCSEC_RAD, rel=0.05)


def test_the_frame_bias_matches_the_iers_conventions(tmp_path: Path) -> None:
    """IERS 2010, 5.4.4: the pole of J2000 is at -16.617 mas and -6.819 mas in the ICRS, its equinox at -14.6 mas."""
    eme = segment(Rotation.identity(5), TIMES[:5], REF_FRAME_A="EME2000")
    icrs_from_mean = read_text(aem(eme), tmp_path).a_from_b[0].as_matrix()
    mas = ARCSEC_RAD / 1000
    np.testing.assert_allclose(
        icrs_from_mean[:2, 2] / mas, [-16.617, -6.819], rtol=0, atol=0.01
    )
    assert icrs_from_mean[1, 0] / mas == pytest.approx(-14.6, abs=0.01)


@pytest.mark.parametrize(
    ("system", "ahead_s"),
    [("UTC", 0.0), ("TAI", 36.0), ("TT", 36.0 + 32.184), ("GPS", 17.0), ("TDB", 68.184)],
)
def test_epochs_of_every_time_system_are_turned_into_utc(
    system: str, ahead_s: float, tmp_path: Path
) -> None:
    """At noon of 31 December 2016, before the leap second: TAI - UTC = 36 s, TT - TAI = 32.184 s, TAI - GPS = 19 s."""
    read = read_text(aem(segment(MOTION, TIMES + ahead_s, TIME_SYSTEM=system)), tmp_path)
    np.testing.assert_allclose(
        read.t_s, TIMES, rtol=0, atol=2e-3 if system == "TDB" else 1e-6
    )


def test_epochs_may_use_the_day_of_the_year(tmp_path: Path) -> None:
    content = aem(segment(MOTION, TIMES))
    read = read_text(content.replace("\n2016-12-31T", "\n2016-366T"), tmp_path)
    np.testing.assert_allclose(read.t_s, TIMES, rtol=0, atol=1e-9)


def test_segments_are_joined(tmp_path: Path) -> None:
    """With a common sample at the seam, with a step between segments, and with reversed frames in the second."""
    first = segment(MOTION[:21], TIMES[:21])
    second = segment(MOTION[20:41], TIMES[20:41])
    third = segment(
        MOTION[41:].inv(),
        TIMES[41:],
        REF_FRAME_A="SC_BODY_1",
        REF_FRAME_B="ICRF",
        QUATERNION_TYPE="LAST",
    )
    read = read_text(aem(first, second, third), tmp_path)
    np.testing.assert_allclose(read.t_s, TIMES, rtol=0, atol=1e-9)
    assert angle(read.a_from_b, MOTION).max() < 1e-14


def turned(axis: int, angle_deg: float) -> np.ndarray:
    """The matrix that converts coordinates to axes turned about the x, y or z axis: R1, R2, R3 of textbooks."""
    sine = math.sin(math.radians(angle_deg))
    cosine = math.cos(math.radians(angle_deg))
    matrix = np.eye(3)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix[[j, k, j, k], [j, k, k, j]] = cosine, cosine, sine, -sine
    return matrix


def with_rows(kind: str, rows: list[str], version: str = "1.0", **meta: str) -> str:
    """An AEM with these numbers, a line for each second."""
    lines = segment(
        Rotation.identity(len(rows)), np.arange(len(rows)), ATTITUDE_TYPE=kind, **meta
    ).split("\n")
    at = lines.index("DATA_START") + 1
    for n, row in enumerate(rows):
        lines[at + n] = f"{lines[at + n].split()[0]} {row}"
    return aem("\n".join(lines), version=version)


@pytest.mark.parametrize("more", ["", "/RATE", "/DERIVATIVE", "/ANGVEL"])
@pytest.mark.parametrize("sequence", ["312", "321", "ZXZ", "131"])
def test_euler_angles_turn_a_into_b_in_their_order(
    sequence: str, more: str, tmp_path: Path
) -> None:
    """b_from_a = R(third) R(second) R(first); CCSDS 504.0-B-1, 4.2.5.4.5: the order is that of the sequence."""
    angles = [[-26.78, 46.26, 144.10], [10.0, 20.0, -30.0]]
    rows = [" ".join(map(str, row + [0.1, 0.2, 0.3] * bool(more))) for row in angles]
    content = with_rows(
        f"EULER_ANGLE{more}", rows, QUATERNION_TYPE="", EULER_ROT_SEQ=sequence
    )
    read = read_text(content, tmp_path)
    axes = ["123".find(one) + "XYZ".find(one) + 1 for one in sequence]
    for found, (a, b, c) in zip(read.a_from_b.as_matrix(), angles, strict=True):
        b_from_a = turned(axes[2], c) @ turned(axes[1], b) @ turned(axes[0], a)
        np.testing.assert_allclose(found.T, b_from_a, rtol=0, atol=1e-14)
    back = with_rows(
        f"EULER_ANGLE{more}",
        rows,
        QUATERNION_TYPE="",
        EULER_ROT_SEQ=sequence,
        ATTITUDE_DIR="B2A",
    )
    inverse = read_text(back, tmp_path)
    assert (inverse.a, inverse.b) == ("body", "icrs")
    assert angle(inverse.a_from_b, read.a_from_b).max() < 1e-14


# Of CCSDS 504.0-B-1, figures 4-2 and 4-3: the spacecraft ST5-224.
SPIN_ROWS = [
    "2.6862511e+002 6.8448486e+001 1.5969509e+002 -1.0996528e+002",
    "2.6863990e+002 6.8432197e+001 1.4593720e+002 -1.0996493e+002",
]
NUTATION_ROWS = [
    "268.62512 68.407179 159.5566582 -109.9677896 0.366382445 18.16999799 -156.19211",
    "268.59578 68.395597 148.3145228 -109.9677896 0.366382445 18.16999799 -169.93808",
]


@pytest.mark.parametrize(
    ("kind", "rows"),
    [
        ("SPIN", SPIN_ROWS),
        ("SPIN/NUTATION", NUTATION_ROWS),
        ("SPIN/NUTATION_MOM", NUTATION_ROWS),
    ],
)
def test_the_spin_axis_is_at_alpha_and_delta(
    kind: str, rows: list[str], tmp_path: Path
) -> None:
    """And x of B is turned about it, by the spin angle, from the node of its equator on that of A."""
    read = read_text(with_rows(kind, rows, QUATERNION_TYPE=""), tmp_path)
    for matrix, row in zip(read.a_from_b.as_matrix(), rows, strict=True):
        alpha, delta, spin = np.radians([float(word) for word in row.split()[:3]])
        axis = [
            math.cos(delta) * math.cos(alpha),
            math.cos(delta) * math.sin(alpha),
            math.sin(delta),
        ]
        node = np.array([-math.sin(alpha), math.cos(alpha), 0.0])  # z x axis
        x = math.cos(spin) * node + math.sin(spin) * np.cross(axis, node)
        np.testing.assert_allclose(matrix[:, 2], axis, rtol=0, atol=1e-14)
        np.testing.assert_allclose(matrix[:, 0], x, rtol=0, atol=1e-14)


def as_xml(content: str, elements: str) -> str:
    """A message in XML; `elements` are the names of its numbers, with / for an element within another."""
    lines = [line for line in content.split("\n") if line and not line.startswith("COMMENT")]
    out = ['<?xml version="1.0" encoding="UTF-8"?>', "<!-- a comment -->"]
    begin = {"META_START": "<segment><metadata>", "DATA_START": "<data>"}
    end = {"META_STOP": "</metadata>", "DATA_STOP": "</data></segment>"}
    for line in lines:
        key, equals, value = (part.strip() for part in line.partition("="))
        if key == "CCSDS_AEM_VERS":
            out.append(f'<aem id="CCSDS_AEM_VERS" version="{value}"><header>')
        elif line in begin or line in end:
            out.append((begin | end)[line])
        elif equals:
            out.append(f"  <{key}>{value}</{key}>")
        else:
            epoch, *numbers = line.split()
            names = elements.split()
            inner = "\n".join(
                f"<{name}>{number}</{name}>"
                for name, number in zip(names, numbers, strict=True)
            )
            out.append(
                f"<attitudeState><x><EPOCH>{epoch}</EPOCH><y>{inner}</y></x></attitudeState>"
            )
        if key == "ORIGINATOR":
            out.append("</header><body>")
    return "\n".join([*out, "</body></aem>"])


def test_xml_is_read_as_its_keywords_are(tmp_path: Path) -> None:
    """A quaternion's scalar is known by its name, wherever it stands; a state takes several lines."""
    last = aem(segment(MOTION, TIMES), version="2.0")
    read = read_text(as_xml(last, "Q1 Q2 Q3 QC"), tmp_path, "p.xml")
    assert read.direction == "icrs_from_body"
    np.testing.assert_allclose(read.t_s, TIMES, rtol=0, atol=1e-9)
    assert angle(read.a_from_b, MOTION).max() < 1e-14
    first = aem(segment(MOTION, TIMES, scalar_first=True, QUATERNION_TYPE="FIRST"))
    read = read_text(as_xml(first, "QC Q1 Q2 Q3"), tmp_path, "p.xml")
    assert angle(read.a_from_b, MOTION).max() < 1e-14
    spin = with_rows("SPIN", SPIN_ROWS, QUATERNION_TYPE="")
    names = "SPIN_ALPHA SPIN_DELTA SPIN_ANGLE SPIN_ANGLE_VEL"
    assert (
        angle(
            read_text(as_xml(spin, names), tmp_path, "p.xml").a_from_b,
            read_text(spin, tmp_path).a_from_b,
        ).max()
        < 1e-15
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "<aem",
            "<!DOCTYPE aem [<!ENTITY a 'b'>]>\n<aem",
            "line 3: XML with a document type",
        ),
        ("</metadata>", "", "not XML: mismatched tag"),
        ("</body></aem>", "", None),
        ("</data></segment>\n</body></aem>", "", "ends within a segment, after DATA_START"),
        ("<Q2>", "<Q2>x", "'x.*' is not a number"),
        ("<SCALAR", "", None),
        ("ICRF", "MARS", "line 10: unknown frame 'MARS'"),
    ],
)
def test_an_error_in_xml_is_reported_with_its_line(
    old: str, new: str, message: str | None, tmp_path: Path
) -> None:
    content = as_xml(aem(segment(MOTION, TIMES)), "Q1 Q2 Q3 QC").replace(old, new)
    if message is None:
        assert len(read_text(content, tmp_path, "p.xml").t_s) == len(TIMES)
        return
    with pytest.raises(InputError, match=message) as raised:
        read_text(content, tmp_path, "p.xml")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (aem(version="3.0"), "CCSDS_AEM_VERS is '3.0'; allowed: 1.0, 2.0"),
        (aem(), "no segment"),
        (aem(segment(MOTION, TIMES, REF_FRAME_A="")), "REF_FRAME_A is missing"),
        (aem(segment(MOTION, TIMES, QUATERNION_TYPE="")), "QUATERNION_TYPE is missing"),
        (
            aem(segment(MOTION, TIMES, ATTITUDE_DIR="A2C")),
            "line 12: ATTITUDE_DIR = 'A2C'; allowed: A2B, B2A",
        ),
        (
            aem(segment(MOTION, TIMES, REF_FRAME_A="TOD_EARTH")),
            "line 10: unknown frame 'TOD_EARTH'; allowed: ICRF",
        ),
        (
            aem(segment(MOTION, TIMES, REF_FRAME_B="EME2000")),
            "line 11: the attitude of EME2000 in ICRF; allowed: one",
        ),
        (
            aem(segment(MOTION, TIMES, TIME_SYSTEM="UT1")),
            "line 13: TIME_SYSTEM = 'UT1'; allowed: UTC, TAI",
        ),
        (
            aem(segment(MOTION, TIMES, ATTITUDE_TYPE="MATRIX")),
            "line 16: ATTITUDE_TYPE = 'MATRIX'; allowed: QUATERNION",
        ),
        (
            aem(segment(MOTION, TIMES, ATTITUDE_TYPE="EULER_ANGLE")),
            "EULER_ROT_SEQ is missing",
        ),
        (
            with_rows("EULER_ANGLE", ["1 2 3"], EULER_ROT_SEQ="112"),
            "line 18: EULER_ROT_SEQ = '112'; allowed: three axes, such as 321 or ZYX",
        ),
        (
            with_rows("SPIN", ["1 2 3"]),
            "line 21: 4 values; allowed: an epoch and 4 numbers",
        ),
        (
            aem(segment(MOTION, TIMES, " 7")),
            "line 21: 6 values; allowed: an epoch and 4 numbers",
        ),
        (
            aem(segment(MOTION, TIMES)).replace("DATA_STOP", ""),
            "ends within a segment, after DATA_START",
        ),
        (aem(segment(MOTION, TIMES)).replace("META_STOP", ""), "DATA_START after META_START"),
        (
            aem(segment(MOTION, TIMES)).replace("TIME_SYSTEM = ", "TIME_SYSTEM "),
            "is not KEYWORD = value",
        ),
        (
            aem(segment(MOTION, TIMES), segment(MOTION, TIMES)),
            "line 98: a segment that begins 6 s before the end",
        ),
        (
            aem(segment(MOTION, TIMES), segment(MOTION, TIMES + 9)),
            "a gap of 3 s between two segments",
        ),
        (
            aem(
                segment(MOTION, TIMES),
                segment(MOTION, TIMES + 6, REF_FRAME_B="STARTRACKER_1"),
            ),
            "a segment of icrs_from_cam after one of icrs_from_body",
        ),
    ],
)
def test_an_error_in_an_aem_is_reported_with_its_line(
    content: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        read_text(content, tmp_path)
    assert str(raised.value).startswith(str(tmp_path / "p.aem"))
    assert "\n" not in str(raised.value)


# --- STK ----------------------------------------------------------------------------------------------------


def stk(
    rotations: Rotation,
    section: str = "AttitudeTimeQuaternions",
    more: str = "",
    **keywords: str,
) -> str:
    rows = rotations.as_quat(scalar_first="First" in section)
    defaults = {
        "NumberOfAttitudePoints": str(len(rows)),
        "ScenarioEpoch": "31 Dec 2016 11:59:30.5",
    }
    defaults |= {"CentralBody": "Earth", "CoordinateAxes": "ICRF", "InterpolationOrder": "1"}
    lines = [f"  {key}\t{value}" for key, value in (defaults | keywords).items() if value]
    data = [
        f"{t!r} {' '.join(map(repr, row))}{more}"
        for t, row in zip(TIMES.tolist(), rows.tolist(), strict=True)
    ]
    return "\n".join(
        [
            "stk.v.11.0",
            "# by us",
            "BEGIN Attitude",
            *lines,
            section,
            *data,
            "END Attitude",
            "",
        ]
    )


@pytest.mark.parametrize(
    ("section", "more"),
    [
        ("AttitudeTimeQuaternions", ""),
        ("attitudetimequatscalarfirst", ""),
        ("AttitudeTimeQuatAngVels", " 1 2 3"),
    ],
)
def test_an_stk_file_has_reference_from_body(section: str, more: str, tmp_path: Path) -> None:
    content = stk(
        MOTION, "AttitudeTimeQuatScalarFirst" if "first" in section else section, more
    )
    content = content.replace("AttitudeTimeQuatScalarFirst", section).replace(
        "END Attitude", ""
    )
    read = read_text(content, tmp_path, "p.a")
    assert (read.direction, read.absolute) == ("icrs_from_body", True)
    np.testing.assert_allclose(read.t_s, TIMES - 29.5, rtol=0, atol=1e-9)
    assert angle(read.a_from_b, MOTION).max() < 1e-14


def test_an_stk_file_without_an_epoch_counts_from_the_maneuver(tmp_path: Path) -> None:
    read = read_text(
        stk(MOTION, ScenarioEpoch="", CoordinateAxes="LAB", NumberOfAttitudePoints="9"),
        tmp_path,
        "p.a",
    )
    assert (read.direction, read.absolute, len(read.t_s)) == ("lab_from_body", False, 9)
    biased = read_text(stk(MOTION, CoordinateAxes="J2000"), tmp_path, "p.a")
    assert angle(biased.a_from_b, MOTION) == pytest.approx(23e-3 * ARCSEC_RAD, rel=0.05)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            stk(MOTION, CoordinateAxes="Fixed"),
            "line 7: CoordinateAxes 'Fixed'; allowed: ICRF, GCRF, LAB, EME2000, J2000",
        ),
        (stk(MOTION, CoordinateAxes=""), "CoordinateAxes ''; allowed: ICRF"),
        (stk(MOTION, CentralBody="Mars"), "line 6: CentralBody 'Mars'; allowed: Earth"),
        (stk(MOTION, TimeFormat="UTCG"), "line 9: TimeFormat 'UTCG'; allowed: EpSec"),
        (
            stk(MOTION, RepeatPattern="yes"),
            "line 9: unknown keyword 'RepeatPattern'; allowed: Numb",
        ),
        (
            stk(MOTION, ScenarioEpoch="yesterday"),
            "line 5: ScenarioEpoch 'yesterday'; allowed: 1 Jul 2005",
        ),
        *(
            (
                stk(MOTION, ScenarioEpoch=f"1 Jul 2005 {clock}"),
                f"line 5: ScenarioEpoch '1 Jul 2005 {clock}'; allowed",
            )
            for clock in (
                "12:-1:00",
                "12:60:00",
                "-1:00:00",
                "24:00:00",
                "12:00:-1",
                "12:00:60",
            )
        ),
        (
            stk(MOTION, NumberOfAttitudePoints="62"),
            "line 4: NumberOfAttitudePoints 62, but there are 61: the file is cut",
        ),
        (
            stk(MOTION, NumberOfAttitudePoints="all"),
            "line 4: NumberOfAttitudePoints 'all'; allowed: a whole number",
        ),
        (
            stk(MOTION, "AttitudeTimeYPRAngles"),
            "line 9: unknown data 'AttitudeTimeYPRAngles'; allowed: AttitudeTimeQ",
        ),
        (stk(MOTION, more=" 1"), "line 10: 6 values; allowed: 5"),
        (
            stk(MOTION).replace("BEGIN Attitude", "BEGIN Ephemeris"),
            "line 3: 'BEGIN Ephemeris'; allowed: BEGIN Attitude",
        ),
        (
            "stk.v.11.0\nBEGIN Attitude\nEND Attitude\n",
            "no attitudes; allowed: AttitudeTimeQuaternions",
        ),
    ],
)
def test_an_error_in_an_stk_file_is_reported_with_its_line(
    content: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        read_text(content, tmp_path, "p.a")
    assert "\n" not in str(raised.value)


def test_a_file_that_names_its_frames_takes_no_other_rotation(tmp_path: Path) -> None:
    path = tmp_path / "p.a"
    path.write_text(stk(MOTION))
    with pytest.raises(
        InputError, match="the file names its frames; allowed: no key rotation"
    ):
        read_profile(path, START, "lab_from_body")


# --- in a list of maneuvers ---------------------------------------------------------------------------------

HOLD = {"kind": "hold", "duration": "2 s"}


def following(*elements: object, begin: str = "zero") -> MotionConfig:
    leg = ProfileConfig.model_construct(kind="profile", file="", begin=begin)
    motion = MotionConfig.model_validate({"control": "pid", "maneuver": elements})
    return motion.model_copy(update={"maneuver": (*motion.maneuver, leg)})


def test_a_profile_counts_from_its_maneuver_or_from_the_scene() -> None:
    """After a hold of 2 s: t_s = 0 then, but epochs stay where they are."""
    from dataclasses import replace

    relative = AttitudeSpline(sampled())
    absolute = AttitudeSpline(replace(sampled(), absolute=True))
    here = tumble(np.array([0.0]))[0]
    late = tumble(np.array([2.0]))[0]
    for spline, start, zero_s in ((relative, here, 2.0), (absolute, late, 0.0)):
        rate = spline.state_at(2.0 - zero_s)[1]
        spin = {"kind": "rate", "rate_deg_s": np.degrees(rate).tolist(), "duration": "2 s"}
        before = start * Rotation.from_rotvec(-2 * rate)
        reference = plan(following(spin), before, (spline,))
        assert reference.start_s == pytest.approx((0, 2, 6 + zero_s), abs=1e-12)
        t = np.linspace(2.001, 6 + zero_s - 0.001, 40)
        assert angle(reference.attitudes(t), attitudes(spline, t - zero_s)).max() < 1e-13


def test_after_its_end_a_profile_continues_at_its_last_rate() -> None:
    spline = AttitudeSpline(sampled())
    motion = following().model_copy(update={"start": "profile"})
    reference = plan(motion, None, (spline,))
    attitude_at_end, rate, _ = spline.state_at(6.0)
    after = Rotation.from_quat(attitude_at_end, scalar_first=True) * Rotation.from_rotvec(
        rate * 1.5
    )
    assert angle(reference.attitudes(np.array([7.5]))[0], after) < 1e-12
    np.testing.assert_allclose(
        reference.state_at(0.0)[1], spline.state_at(0.0)[1], rtol=0, atol=1e-15
    )


def test_a_profile_that_does_not_start_where_the_previous_element_ends_is_refused() -> None:
    spline = AttitudeSpline(sampled())
    with pytest.raises(
        InputError,
        match=r"motion.maneuver: it: begins \S+ deg and \S+ deg/s away .* motion.start: pro",
    ):
        plan(following(), Rotation.identity(), (spline,))
    late = AttitudeSpline(sampled(TIMES + 3.0))
    with pytest.raises(
        InputError,
        match=r"attitudes from 3 s to 9 s after .* allowed: from 0.1 s \(a step\) at most",
    ):
        plan(following(), tumble(np.array([3.0]))[0], (late,))
    first = following(begin="first_sample").model_copy(update={"start": "profile"})
    assert plan(first, None, (late,)).duration_s == pytest.approx(6.0, abs=1e-12)
    with pytest.raises(InputError, match="attitudes from -9 s to -3 s after"):
        plan(following(), tumble(np.array([3.0]))[0], (AttitudeSpline(sampled(TIMES - 9.0)),))


def test_the_vehicle_starts_at_the_first_profile_s_attitude() -> None:
    first = AttitudeSpline(sampled(TIMES + 3.0))
    second = AttitudeSpline(sampled(TIMES + 20.0))
    motion = following(begin="first_sample").model_copy(update={"start": "profile"})
    start_wxyz, _, _ = profile_start(motion, (first, second))
    assert (
        angle(Rotation.from_quat(start_wxyz, scalar_first=True), tumble(np.array([3.0]))[0])
        < 1e-12
    )


def test_the_spline_matches_scipy(tmp_path: Path) -> None:
    """Sample by sample against CubicSpline, whose coefficients it evaluates."""
    cubic = CubicSpline(TIMES, MOTION.as_quat(scalar_first=True))
    t = np.linspace(0, 6, 700)
    p = cubic(t)
    np.testing.assert_allclose(
        AttitudeSpline(sampled()).states_at(t)[0],
        p / np.linalg.norm(p, axis=1)[:, None],
        rtol=0,
        atol=1e-14,
    )
