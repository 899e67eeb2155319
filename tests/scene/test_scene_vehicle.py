"""A scene's vehicle, motion and base: units, and one error line for contradicting keys."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.scene import loader, scene


def loaded(**sets: str) -> scene.Scene:
    return loader.load(
        "afit_simsat", {key.replace("__", "."): value for key, value in sets.items()}
    )


# --- units --------------------------------------------------------------------------------------------------


def test_vehicle_quantities_become_si() -> None:
    given = loaded(
        vehicle__wheels="{torque_limit: 600 mN m, coulomb: 2 mN m, viscous: 2e-5 N m s, static_imbalance: 0.5 g cm,"
        " dynamic_imbalance: 10 g cm2}",
        vehicle__fans="{thrust_limit: 500 mN, time_constant: 200 ms}",
        vehicle__cmgs="{gimbal_time_constant: 12 ms, rotor_torque_limit: 0.4 N m}",
        vehicle__drag="{viscous: 1 mN m s, quadratic: 7 mN m s2}",
        vehicle__disturbances="{turbine: [0 N m, 0 N m, 0.2 mN m], cable: {stiffness: 2 mN m / deg},"
        " air_current: {rms: [1 mN m, 2 mN m, 3 mN m], correlation: 900 ms}}",
        motion__control="{law: pd, actuators: wheels, desaturation: {start: 1.7 N m s, stop: 800 mN m s, time: 5 s}}",
    )
    vehicle = given.vehicle
    control = given.motion.control
    assert vehicle.wheels is not None
    assert vehicle.fans is not None
    assert vehicle.cmgs is not None
    assert vehicle.disturbances.cable is not None
    assert vehicle.disturbances.air_current is not None
    assert control is not None
    assert control.desaturation is not None
    figures = {
        0.6: vehicle.wheels.torque_limit_nm,
        2e-3: vehicle.wheels.coulomb_nm,
        2e-5: vehicle.wheels.viscous_nms,
        0.5e-5: vehicle.wheels.static_imbalance_kg_m,
        1e-6: vehicle.wheels.dynamic_imbalance_kg_m2,
        0.5: vehicle.fans.thrust_limit_n,
        0.2: vehicle.fans.time_constant_s,
        0.012: vehicle.cmgs.gimbal_time_constant_s,
        0.4: vehicle.cmgs.rotor_torque_limit_nm,
        1e-3: vehicle.drag.viscous_nms,
        7e-3: vehicle.drag.quadratic_nms2,
        2e-4: vehicle.disturbances.turbine_nm[2],
        2e-3 * 57.29577951308232: vehicle.disturbances.cable.stiffness_nm_rad,
        3e-3: vehicle.disturbances.air_current.rms_nm[2],
        0.9: vehicle.disturbances.air_current.correlation_s,
        1.7: control.desaturation.start_nms,
        0.8: control.desaturation.stop_nms,
        5.0: control.desaturation.time_s,
    }
    assert list(figures.values()) == pytest.approx(list(figures), rel=1e-12)


def test_a_controller_s_name_abbreviates_its_section() -> None:
    law = loaded(motion__control="pd").motion.control
    assert law is not None
    assert (law.law, law.actuators, law.feedback, law.rate_hz) == (
        "pd",
        "ideal",
        "truth",
        100,
    )
    assert loaded(motion__control="none", motion__maneuver="[]").motion.control is None


# --- what goes together -------------------------------------------------------------------------------------

WRONG = [
    ({"filter": "{}"}, "filter: requires the section vehicle.imu"),
    (
        {"motion.control": "{actuators: wheels}"},
        "motion.control.actuators: requires the section vehicle.wheels",
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
        {
            "vehicle.wheels": "{}",
            "motion.control": "{actuators: wheels, desaturation: {start: 2 N m s, stop: 1 N m s}}",
        },
        "motion.control.desaturation: requires vehicle.fans, and actuators wheels or cmgs",
    ),
    (
        {"motion.control": "{desaturation: {start: 1 N m s, stop: 1 N m s}}"},
        "desaturation.stop: 1 N m s is not below start 1 N m s",
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
        {
            "vehicle.mount": "free",
            "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
            "vehicle.disturbances": "{earth_rotation: true}",
        },
        "disturbances: a free vehicle has none; allowed: mount: air_bearing",
    ),
    (
        {"vehicle.mount": "free", "vehicle.imu": "{earth_rate: compensated}"},
        "imu.earth_rate: a free vehicle is not on the Earth; allowed: none",
    ),
    ({"motion.control": "none"}, "a maneuver requires a controller, such as control: pid"),
    (
        {
            "motion.maneuver": "[{kind: bump, rate_deg_s: [1, 0, 0], duration: 50 ms, caught_after: 40 ms}]"
        },
        "caught_after: 0.04 s is before the impulse ends",
    ),
    ({"vehicle.wheels": "{coulomb: 2 mN}"}, "'2 mN' is not a torque"),
    ({"vehicle.drag": "{viscous: 0.1}"}, "0.1 has no unit"),
    (
        {"vehicle.cmgs": "{steering: moore_penrose}"},
        "'pseudo_inverse' or 'singularity_robust'",
    ),
    ({"vehicle.wheels": "{speed_limit: 3000}"}, "did you mean speed_limit_rpm?"),
    (
        {"vehicle.disturbances": "{air_current: {rms: [0 N m, 0 N m, -1 N m]}}"},
        "greater than or equal to 0",
    ),
]


@pytest.mark.parametrize(("sets", "says"), WRONG)
def test_contradicting_vehicle_keys_are_refused_in_one_line(
    sets: dict[str, str], says: str
) -> None:
    with pytest.raises(InputError) as raised:
        loader.load("afit_simsat", sets)
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_bump_needs_no_controller() -> None:
    scene = loaded(
        motion__control="none",
        motion__maneuver="[{kind: hold, duration: 1 s}, {kind: bump, rate_deg_s: [1, 0, 0], duration: 50 ms}]",
    )
    assert scene.motion.control is None


# --- base ---------------------------------------------------------------------------------------------------


def written(folder: Path, name: str, **tree: object) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"schema": 1} | tree, sort_keys=False), encoding="utf-8")
    return path


def test_a_scene_contains_only_differences_from_its_base(tmp_path: Path) -> None:
    below = loader.load("afit_simsat")
    mine = loader.load(
        written(
            tmp_path,
            "mine",
            base="afit_simsat",
            seed=77,
            vehicle={"mass": "90 kg"},
            camera={"f_number": 11},
        )
    )
    assert (mine.seed, mine.vehicle.mass_kg, mine.camera.f_number, mine.name) == (
        77,
        90,
        11,
        "mine",
    )
    assert mine.vehicle.inertia_kg_m2 == below.vehicle.inertia_kg_m2
    assert mine.camera.focal_length_m == below.camera.focal_length_m
    assert (mine.light, mine.motion, mine.title) == (below.light, below.motion, below.title)


def test_other_kinds_and_lists_replace_the_base_s_and_null_removes_a_section(
    tmp_path: Path,
) -> None:
    path = written(
        tmp_path,
        "mine",
        base="simsat_bump",
        camera={"psf": {"kind": "airy", "wavelength": "550 nm"}},
        motion={"maneuver": [], "control": "pid"},
        filter=None,
    )
    mine = loader.load(path)
    assert (mine.camera.psf.kind, mine.motion.maneuver, mine.filter) == ("airy", (), None)
    assert mine.vehicle.imu == loader.load("simsat_bump").vehicle.imu


def test_a_base_beside_the_scene_resolves_its_own_files(tmp_path: Path) -> None:
    """The base's vehicle file is found beside the base although the scene is in another folder."""
    lab = tmp_path / "lab"
    campaign = tmp_path / "campaign"
    lab.mkdir()
    campaign.mkdir()
    model = (SCENES / "vehicles" / "simsat.xml").read_text(encoding="utf-8")
    (lab / "ours.xml").write_text(model, encoding="utf-8")
    written(lab, "ours", base="afit_simsat", vehicle={"model": "ours.xml"})
    mine = loader.load(written(campaign, "mine", base="../lab/ours.yaml", seed=5))
    assert Path(mine.vehicle.model) == lab / "ours.xml"


def test_an_unusable_base_is_reported_with_its_line(tmp_path: Path) -> None:
    path = written(tmp_path, "mine", title="mine", base="nothing")
    with pytest.raises(
        InputError,
        match=r"^base: nothing: no such scene; allowed: .* \(.*mine.yaml, line 3\)$",
    ):
        loader.load(path)


def test_a_scene_is_not_its_own_base(tmp_path: Path) -> None:
    written(tmp_path, "one", base="two.yaml")
    two = written(tmp_path, "two", base="one.yaml")
    with pytest.raises(InputError, match=r"^base: .* leads back to this scene"):
        loader.load(two)


def test_an_error_names_the_file_that_contains_it(tmp_path: Path) -> None:
    written(tmp_path, "below", base="afit_simsat", exposure={"time": "3 kg"})
    above = written(
        tmp_path, "above", base="below.yaml", vehicle={"wheels": {"coulomb": "1 m"}}
    )
    with pytest.raises(
        InputError,
        match=r"vehicle.wheels.coulomb: '1 m' is not a torque.*above.yaml, line 5\)",
    ):
        loader.load(above)
    above = written(tmp_path, "above", base="below.yaml", vehicle={"wheels": {}})
    with pytest.raises(
        InputError, match=r"exposure.time: '3 kg' is not a time.*below.yaml, line 4\)"
    ):
        loader.load(above)
