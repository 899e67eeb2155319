"""Trackers and profiles given in Python, prescribed motions, and motions that the vehicle cannot follow."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import estimator
import skysim
from skysim.core.errors import InputError
from skysim.core.types import Telemetry
from skysim.dynamics.guidance import plan
from skysim.results.files import recording, run_export
from skysim.results.run import Run
from skysim.scene import loader
from skysim.simulation.checks.plan_check import broken_assumptions
from skysim.simulation.flight import Flight, open_flight, simulate_motion
from skysim.simulation.lab import build_lab
from skysim.tracking.tracker_interface import Answer


def exposures(first: str, frames: int = 1, rate_hz: int = 1) -> dict[str, Any]:
    keys = {"time": "10 ms", "rate_hz": rate_hz, "frames": frames, "first": first}
    return {f"exposure.{key}": value for key, value in keys.items()}


ONE = exposures("2 s")
PRESCRIBED = {"motion.control": "prescribed", **ONE}
TIMES = np.arange(0.0, 4.05, 0.1)


def swing(t_s: np.ndarray, size_deg: float = 8.0) -> dict[str, np.ndarray]:
    """Columns of a profile: a yaw by some degrees and a tilt, from rest."""
    share = (1 - np.cos(np.pi * t_s / 4)) / 2
    return {
        "t_s": t_s,
        "roll_deg": size_deg * share,
        "pitch_deg": -size_deg / 2 * share,
        "yaw_deg": 2 * size_deg * share,
    }


def attitudes(columns: dict[str, np.ndarray]) -> Rotation:
    return Rotation.from_euler(
        "ZYX", np.column_stack([columns[f"{n}_deg"] for n in ("yaw", "pitch", "roll")]), True
    )


def moved(
    scene: str = "afit_simsat", changes: dict[str, Any] | None = None, **parts: Any
) -> Flight:
    return open_flight(
        skysim.load_scene(scene, ONE | (changes or {})), **parts
    ).simulate_motion()


def profile_scene(folder: Path, columns: dict[str, np.ndarray], **changes: Any) -> Path:
    """A scene file in a folder with the profile beside it."""
    rows = "".join(
        ",".join(map(repr, row)) + "\n"
        for row in np.column_stack(list(columns.values())).tolist()
    )
    (folder / "swing.csv").write_text(",".join(columns) + "\n" + rows)
    (folder / "mine.yaml").write_text(
        "schema: 1\nbase: afit_simsat\ntitle: Mine\nmotion:\n  start: profile\n  maneuver:\n"
        "    - {kind: profile, file: swing.csv}\n    - {kind: hold, duration: 1 s}\n"
    )
    return folder / "mine.yaml"


def angle(a: Rotation, b: Rotation) -> np.ndarray:
    return np.linalg.norm((a.inv() * b).as_rotvec(), axis=-1)


# --- prescribed motions -------------------------------------------------------------------------------------


def test_a_prescribed_motion_equals_its_reference() -> None:
    """A slew of a vehicle out of balance, at every step of a millisecond; and the rate is the reference's."""
    flight = moved(changes=PRESCRIBED)
    reference = plan(flight.lab.scene.motion)
    path = flight.trajectory()
    assert angle(path.lab_from_body, reference.attitudes(path.t_s)).max() < 1e-15
    np.testing.assert_array_equal(
        path.rate_body_rad_s[::100], [reference.state_at(t)[1] for t in path.t_s[::100]]
    )
    assert np.degrees(path.lab_from_body.magnitude()).max() > 0.3
    np.testing.assert_array_equal(flight.telemetry().torque_nm, 0)
    pushed = moved(changes={"motion.control": "pid"})
    assert (
        angle(pushed.trajectory().lab_from_body, reference.attitudes(path.t_s)).max() > 1e-6
    )


def test_a_prescribed_motion_is_measured_by_the_gyros() -> None:
    """The sum of their angles is the integral of the prescribed rate, to their noise and quantization."""
    changes = {
        "motion.control": "prescribed",
        "motion.start": {},
        "motion.maneuver": [
            {"kind": "slew", "yaw_deg": 8, "rate_deg_s": 4, "acceleration_deg_s2": 4}
        ],
        "filter": None,
        **exposures("4 s"),
    }
    samples = moved("simsat_bump", changes).imu_samples()
    assert samples is not None
    np.testing.assert_allclose(
        np.degrees(samples.angle_rad.sum(axis=0)), [0, 0, 8], rtol=0, atol=0.02
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"motion.maneuver": [{"kind": "step", "duration": "1 s"}]},
            "motion.maneuver: step is not possible with control:",
        ),
        (
            {
                "motion.maneuver": [
                    {"kind": "bump", "rate_deg_s": [1, 0, 0], "duration": "1 s"}
                ]
            },
            "bump is not possible",
        ),
        (
            {"motion.control": {"law": "prescribed", "actuators": "wheels"}},
            "actuators has no effect with law prescribed",
        ),
        (
            {"motion.start": "profile"},
            "start: profile requires a first maneuver of kind profile",
        ),
        ({"motion.start": "rest"}, "motion.start: 'rest' is not allowed; allowed: 'profile'"),
        (
            {"motion.maneuver": [{"kind": "slew", "roll_deg": 40}], "exposure.frames": 30},
            "tilt of 30.1 deg at",
        ),
    ],
)
def test_keys_that_contradict_a_prescribed_motion_are_refused(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        simulate_motion(skysim.load_scene("afit_simsat", PRESCRIBED | changes))


# --- profiles -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_table_is_followed_exactly_without_a_controller_and_closely_with_one() -> None:
    columns = swing(TIMES)
    exact = moved(
        "afit_simsat", {"motion.control": None, "motion.maneuver": []}, profile=columns
    )
    assert exact.lab.scene.motion.is_prescribed
    assert (
        angle(exact.trajectory().attitude_at(TIMES[:20]), attitudes(columns)[:20]).max()
        < 1e-12
    )
    flown = moved("afit_simsat", {"motion.control": "pid"}, profile=columns)
    off_deg = np.degrees(
        angle(flown.trajectory().attitude_at(TIMES[:20]), attitudes(columns)[:20])
    )
    assert 1e-6 < off_deg.max() < 0.02


@pytest.mark.slow
def test_a_profile_beside_its_scene_starts_the_vehicle_and_ends_in_a_hold(
    tmp_path: Path,
) -> None:
    """Named relative to the scene; the vehicle starts on it, moving; then the next maneuver."""
    columns = swing(np.arange(1.0, 4.05, 0.1))
    columns["t_s"] = columns["t_s"] - 1.0
    path = profile_scene(tmp_path, columns)
    flight = simulate_motion(
        loader.load(path, {"exposure.frames": "1", "exposure.first": "3.5 s"})
    )
    motion = flight.trajectory()
    assert angle(motion.lab_from_body[0], attitudes(columns)[0]) < 1e-9
    assert np.degrees(np.linalg.norm(motion.rate_body_rad_s[0])) > 3
    assert angle(motion.lab_from_body[-1], attitudes(columns)[-1]) < 1e-3
    assert broken_assumptions(flight.lab) == broken_assumptions(
        build_lab(loader.load("afit_simsat"))
    )


def test_an_error_in_a_profile_names_the_lines_of_file_and_scene(tmp_path: Path) -> None:
    columns = swing(TIMES)
    path = profile_scene(tmp_path, columns)
    table = tmp_path / "swing.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:9], lines[8], *lines[9:]]))
    with pytest.raises(InputError) as raised:
        build_lab(loader.load(path))
    message = str(loader.located(raised.value, str(path), {}))
    assert re.fullmatch(
        rf"motion.maneuver.0: {table}, line 10: time 0.7 s is not after 0.7 s, by .* at least \({path}, line 7\)",
        message,
    )
    table.unlink()
    with pytest.raises(
        InputError,
        match=r"motion.maneuver.0.file: .*swing.csv' is not a file; .*mine.yaml, line 7",
    ):
        loader.load(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "changes", "size_deg", "message"),
    [
        (
            "afit_simsat",
            {"vehicle.torque_limit": "0.01 N m"},
            8,
            r"needs a torque of \(.*\) N m at .* actuators ideal",
        ),
        (
            "simsat_slew",
            {"motion.control": {"actuators": "wheels"}},
            12,
            r"times what the actuators wheels can give",
        ),
        (
            "simsat_bump",
            {"filter": None, "motion.control": {"feedback": "imu"}},
            17,
            r"deg/s about a body axis at .*10$",
        ),
        ("afit_simsat", {}, 40, r"tilt of 30.\d deg at"),
    ],
)
def test_a_profile_that_the_vehicle_cannot_follow_is_refused(
    scene: str, changes: dict[str, Any], size_deg: float, message: str
) -> None:
    """The torque of Euler's equation, the gyros' range and the tilt stop. A fifth of the angles is followed."""
    ways = exposures("4 s") | changes
    with pytest.raises(InputError, match=message) as raised:
        moved(scene, ways, profile=swing(TIMES, size_deg))
    assert str(raised.value).startswith("motion.maneuver")
    if "torque_limit" not in str(changes):
        moved(scene, ways | {"exposure.first": "0.1 s"}, profile=swing(TIMES, size_deg / 5))


@pytest.mark.slow
def test_the_torque_of_a_profile_satisfies_eulers_equation() -> None:
    """Just refused by a limit below it and just allowed above: J alpha + w x J w, largest over the samples."""
    columns = swing(TIMES)
    lab = open_flight(skysim.load_scene("afit_simsat", ONE), profile=columns).lab
    _, rate, acceleration = lab.profiles[0].states_at(TIMES)
    inertia = lab.vehicle.inertia_kg_m2
    torque = acceleration @ inertia + np.cross(rate, rate @ inertia)
    for share, fits in ((0.999, False), (1.001, True)):
        limit = {"vehicle.torque_limit": f"{share * float(np.abs(torque).max())!r} N m"}
        if fits:
            moved(changes=limit, profile=columns)
        else:
            with pytest.raises(InputError, match="needs a torque"):
                moved(changes=limit, profile=columns)


def test_a_chirp_beyond_the_vehicle_or_the_control_rate_is_refused() -> None:
    def chirp(**more: float) -> dict[str, Any]:
        element = {
            "kind": "chirp",
            "amplitude_deg": [0.2, 0, 0],
            "from_hz": 0.5,
            "to_hz": 1.0,
            "duration": "4 s",
        } | more
        return {"motion.maneuver": [element]}

    moved(changes=chirp())
    with pytest.raises(InputError, match=r"motion.maneuver.0: chirp: needs a torque of"):
        moved(changes=chirp(to_hz=9.0))
    with pytest.raises(
        InputError, match=r"a chirp of 60 Hz requires a motion\.control\.rate_hz above 120"
    ):
        loader.load(
            "afit_simsat", {"motion.maneuver": str(chirp(from_hz=60.0)["motion.maneuver"])}
        )
    for wrong, message in (
        ({"to_hz": 0.5}, "from_hz and to_hz are both 0.5"),
        ({"duration": "2.9 s"}, "shorter than a period"),
    ):
        with pytest.raises(InputError, match=message):
            skysim.load_scene("afit_simsat", chirp(**wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sweep", "middle_hz"), [("linear", 1.75), ("log", math.sqrt(0.5 * 3.0))]
)
def test_a_chirp_has_its_declared_frequency(sweep: str, middle_hz: float) -> None:
    """From zero crossings of the angle half way: amplitude and period of the oscillation there."""
    element = {
        "kind": "chirp",
        "amplitude_deg": [0, 0, 2],
        "from_hz": 0.5,
        "to_hz": 3.0,
        "duration": "40 s",
        "sweep": sweep,
    }
    scene = skysim.load_scene("afit_simsat", {"motion.maneuver": [element]})
    t = np.arange(19.0, 21.0, 1e-4)
    yaw = np.degrees(plan(scene.motion).attitudes(t).as_rotvec()[:, 2])
    crossings = t[1:][np.diff(np.sign(yaw)) != 0]
    near = np.argmin(np.abs(crossings - 20.0))
    period_s = crossings[near + 1] - crossings[near - 1]
    assert 1 / period_s == pytest.approx(middle_hz, rel=0.02)
    assert yaw.max() == pytest.approx(2.0, rel=1e-3)


# --- exported and flown again -------------------------------------------------------------------------------

AGAIN = [
    ("simsat_slew", {}, "motion.aem"),  # true attitudes at 100 Hz
    (
        "shefex2",
        {"exposure.first": "40 ms"},
        "truth.aem",
    ),  # at mid-exposure, under the stars: the camera's
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "changes", "file"), AGAIN)
def test_a_run_exported_and_flown_again_has_the_same_centroids(
    name: str, changes: dict[str, Any], file: str, tmp_path: Path
) -> None:
    """Every light of every frame to a thousandth of a pixel: at mid-exposure, and its smeared image."""
    scene = skysim.load_scene(name, {"exposure.frames": 4} | changes)
    flown = skysim.simulate(scene)
    folder = flown.save(tmp_path)
    run_export.export(
        recording.Recording(folder),
        ["aem"],
        folder,
        lambda items, count, label: iter(items),
    )
    profile = [{"kind": "profile", "file": str(folder / file)}]
    motion = {
        "motion.start": "profile",
        "motion.rate_deg_s": [0, 0, 0],
        "motion.maneuver": profile,
    }
    again = skysim.simulate(
        skysim.load_scene(
            name, {"exposure.frames": 4, "motion.control": "prescribed"} | changes | motion
        )
    )
    rates = [frame.row.rate_deg_s for frame in flown]
    assert max(rates) > 0.4
    for before, after in zip(flown, again, strict=True):
        true = before.truth.sources
        repeated = after.truth.sources
        np.testing.assert_array_equal(repeated.id, true.id)
        np.testing.assert_allclose(repeated.xy_px, true.xy_px, rtol=0, atol=1e-3)
        np.testing.assert_allclose(repeated.flux_xy_px, true.flux_xy_px, rtol=0, atol=1e-3)


# --- trackers -----------------------------------------------------------------------------------------------

STILL = {"exposure.frames": 2, "motion.rate_deg_s": [0, 0, 0]}


@pytest.fixture(scope="module")
def sky() -> Run:
    return skysim.simulate(skysim.load_scene("shefex2", STILL))


@pytest.mark.slow
def test_a_function_of_an_image_is_a_tracker(sky: Run) -> None:
    """Every form of return value is accepted; the function gets each image once, in order, unchanged."""
    truth = sky[0].truth.cam_from_lab
    images = []
    error = Rotation.from_rotvec([1e-4, 0, 0])
    for form in (
        error * truth,
        (error * truth).as_quat(),
        (error * truth).as_quat().tolist(),
    ):
        images.clear()

        def mine(image: np.ndarray, form: Any = form) -> Any:
            images.append(image)
            return form

        run_ = skysim.simulate(skysim.load_scene("shefex2", STILL), tracker=mine)
        assert run_.scene.tracker.name == "mine"
        assert [frame.row.status for frame in run_] == ["solved", "solved"]
        assert run_[1].error_arcsec == pytest.approx(1e-4 * 206264.8, rel=1e-6)
        assert [
            np.array_equal(image, frame.image)
            for image, frame in zip(images, sky, strict=True)
        ] == [True, True]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (None, "no attitude"),
        (Answer("too few stars"), "too few stars"),
        ([0, 0, 0, 2], "failed: ValueError: cam_from_ref_xyzw has norm 2; allowed: 1"),
        (3, "failed: ValueError: the tracker returned int; allowed: Answer"),
        (ZeroDivisionError("by\nday"), "failed: ZeroDivisionError: by day"),
    ],
)
def test_an_exception_of_a_tracker_function_is_the_frame_s_status(
    answer: Any, status: str
) -> None:
    def mine(image: np.ndarray) -> Any:
        if isinstance(answer, Exception):
            raise answer
        return answer

    run_ = skysim.simulate(
        skysim.load_scene("shefex2", STILL | {"exposure.frames": 1}), tracker=mine
    )
    assert run_[0].row.status == status


@pytest.mark.slow
def test_an_estimator_or_a_registered_name_serves_as_tracker(sky: Run) -> None:
    height_px, width_px = sky[0].image.shape
    camera = estimator.Camera.from_fov(width_px, height_px, fov_deg=14.87)
    theirs = estimator.StarTracker.for_sky(
        camera, limit_mag=6, date="2012-06-22", focal_uncertainty=0.05
    )
    scene = skysim.load_scene("shefex2", STILL | {"exposure.frames": 1})
    (frame,) = skysim.simulate(scene, tracker=theirs)
    assert frame.attitude.cam_from_ref is not None
    expected = theirs.solve(sky[0].image).attitude.cam_from_ref
    assert (frame.attitude.cam_from_ref * expected.inv()).magnitude() == 0
    (named,) = skysim.simulate(scene, tracker="own")
    assert named.error_arcsec == sky[0].error_arcsec
    with pytest.raises(
        InputError, match=r"tracker.name: unknown tracker 'nobody's'|unknown tracker 'nobody'"
    ):
        skysim.simulate(scene, tracker="nobody")
    for wrong, message in (
        (5, "tracker: int; allowed"),
        (estimator.StarTracker, "tracker: the class StarTracker; allowed"),
    ):
        with pytest.raises(InputError, match=message):
            skysim.simulate(scene, tracker=wrong)


@pytest.mark.slow
def test_a_function_s_attitudes_reach_the_filter_and_the_controller() -> None:
    """With a covariance: a tracker that errs by half a degree of yaw pulls filter and vehicle to it."""
    changes = {
        "motion.start": {},
        "motion.maneuver": [],
        **exposures("0.1 s", frames=12, rate_hz=4),
        "filter.gate_sigma": 1e6,
        "filter.latency": "0 s",
    }
    scene = skysim.load_scene("simsat_bump", changes)
    lab = build_lab(scene)
    error = Rotation.from_rotvec([0, 0, math.radians(0.5)])
    believed = lab.camera.mount.cam_from_body * error

    def mine(image: np.ndarray) -> Answer:
        return Answer("solved", believed.as_quat(), np.eye(3) * 1e-10)

    telemetry: Telemetry = skysim.simulate(scene, tracker=mine).telemetry
    assert telemetry.lab_from_filter is not None
    assert np.degrees(telemetry.lab_from_filter.as_rotvec()[:, 2].min()) == pytest.approx(
        -0.5, abs=0.05
    )
    assert np.degrees(telemetry.lab_from_body[-1].as_rotvec()[2]) > 0.1


def test_a_missing_profile_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"profile: nowhere\.csv is not a file; allowed: a file, or a table"
    ):
        skysim.simulate(skysim.load_scene("shefex2", STILL), profile="nowhere.csv")
    with pytest.raises(
        InputError,
        match=r"motion.maneuver.0: profile: attitudes lab_from_body with light of kind stars",
    ):
        skysim.simulate(skysim.load_scene("shefex2", STILL), profile=swing(TIMES))
