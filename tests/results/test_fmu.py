"""A laboratory as an FMU, run by fmpy and by a host in C: equal to the flight in Python, clear about misuse."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import skysim
from skysim.core.errors import InputError
from skysim.core.types import Record
from skysim.dynamics.multibody import model
from skysim.results.files import fmu
from skysim.simulation.flight import Flight, Shot
from skysim.simulation.lab import build_lab

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")
pythonfmu3 = pytest.importorskip("pythonfmu3")

PERIOD_S = 0.01
KINDS = {"Float64": float, "Int64": int, "Boolean": bool}


class Host:
    """A unit in fmpy, with values by name."""

    def __init__(self, path: Path, folder: Path) -> None:
        self.description = fmpy.read_model_description(str(path))
        self.messages: list[str] = []
        self.variables = {one.name: one for one in self.description.modelVariables}
        self.unit = fmpy.instantiate_fmu(
            fmpy.extract(str(path), str(folder)),
            self.description,
            "CoSimulation",
            logger=lambda _environment, _status, _category, text: self.messages.append(
                text.decode()
            ),
        )

    def set(self, name: str, *values: Any) -> None:
        one = self.variables[name]
        getattr(self.unit, f"set{one.type}")([one.valueReference], list(values))

    def get(self, name: str) -> Any:
        one = self.variables[name]
        count = math.prod(one.shape or (1,))
        values = getattr(self.unit, f"get{one.type}")([one.valueReference], count)
        return np.array(values) if one.shape else KINDS[one.type](values[0])

    def initialize(self) -> None:
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def outputs(self) -> Record:
        return {
            name: self.get(name)
            for name, one in self.variables.items()
            if one.causality in ("output", "independent")
        }


def processes(path: Path) -> list[str]:
    """The processes that run a unit below a folder."""
    found = []
    for one in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = one.read_bytes().decode(errors="replace")
        except OSError:
            continue  # it has just ended
        if "laboratory_slave.py" in command and str(path) in command:
            found.append(command)
    return found


@pytest.fixture(scope="module")
def bump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unit of simsat_bump."""
    path = tmp_path_factory.mktemp("unit") / "bump.fmu"
    fmu.write_unit(path, skysim.load_scene("simsat_bump"))
    return path


@pytest.fixture
def host(bump: Path, tmp_path: Path) -> Iterator[Host]:
    one = Host(bump, tmp_path)
    yield one
    one.unit.freeInstance()
    assert processes(tmp_path) == []


def expected(flight: Flight, shots: list[Shot], begin_s: float) -> Record:
    """The outputs, from the flight's own state; those of a camera only if it has an exposure."""
    state = flight.state
    samples = flight.imu_samples()
    assert samples is not None
    middle_s = samples.t_s - samples.step_s / 2
    new = (middle_s > begin_s) & (middle_s < flight.now_s)
    values: Record = {
        "t_s": state.t_s,
        "true.lab_from_body_xyzw": state.lab_from_body.as_quat(),
        "true.rate_body_rad_s": state.rate_body_rad_s,
        "imu.angle_rad": samples.angle_rad[new].sum(axis=0),
        "imu.velocity_m_s": samples.velocity_m_s[new].sum(axis=0),
        "imu.samples": int(new.sum()),
        "imu.saturated": bool(samples.saturated[new].any()),
    }
    for shot in shots:
        assert shot.report is not None
        attitude = shot.report.attitude
        assert attitude.cam_from_ref is not None
        assert attitude.covariance_rad2 is not None
        values |= {
            "main.frame": shot.frame.index,
            "main.t_mid_s": shot.frame.t_mid_s,
            "main.exposed_s": shot.frame.exposure_s,
            "main.solved": attitude.solved,
            "main.cam_from_ref_xyzw": attitude.cam_from_ref.as_quat(),
            "main.sigma_rad": np.sqrt(np.diag(attitude.covariance_rad2)),
            "main.true_t_mid_s": shot.truth.t_s,
            "main.true_cam_from_ref_xyzw": shot.truth.mean_cam_from_lab.as_quat(),
        }
    return values


def agree(found: Record, wanted: Record) -> None:
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=0, abs=1e-12), name


@pytest.mark.slow
def test_the_unit_flies_as_the_flight_in_python(host: Host, tmp_path: Path):
    """The scene's controller, then torques, then it again; frames of two exposure times: all outputs to 1e-12."""
    host.initialize()
    solved = 0
    with Flight(build_lab(skysim.load_scene("simsat_bump"))) as flight:
        agree(host.outputs(), {"t_s": 0.0, "main.frame": -1, "imu.samples": 0})
        for k in range(220):
            torque = np.array([0.02, -0.01, 0.03 * math.cos(k / 20)])
            is_given = 60 <= k < 150
            host.set("torque_nm", *torque)
            host.set("torque_nm_given", is_given)
            if k == 110:
                host.set("main.exposure_s", 0.004)
                flight.schedules[0].exposure_control.exposure_s = 0.004
            begin_s = flight.now_s
            host.unit.doStep(begin_s, PERIOD_S)
            shots = flight.step(torque if is_given else None)
            found = host.outputs()
            agree(found, expected(flight, shots, begin_s))
            assert found["main.is_new"] == bool(shots)
            solved += len(shots)
    assert solved == 4
    assert found["main.exposed_s"] == 0.004
    assert len(processes(tmp_path)) == 1
    host.unit.terminate()
    assert processes(tmp_path) == []


@pytest.mark.slow
def test_longer_steps_resets_and_seeds(host: Host):
    """Ten periods at once: the same state, and the sum of the increments. A reset begins anew, with a seed's noise."""
    host.initialize()
    gyros = np.zeros(3)
    for k in range(60):
        host.unit.doStep(k * PERIOD_S, PERIOD_S)
        gyros += host.get("imu.angle_rad")
    first = host.outputs()
    found = []
    for seed in (6, 7):
        host.unit.reset()
        host.set("seed", seed)
        host.initialize()
        turned = np.zeros(3)
        for k in range(6):
            host.unit.doStep(k * 10 * PERIOD_S, 10 * PERIOD_S)
            turned += host.get("imu.angle_rad")
        found.append(host.outputs() | {"turned": turned})
    solution = "main.cam_from_ref_xyzw"
    same = ["t_s", "true.lab_from_body_xyzw", "filter.lab_from_body_xyzw", solution]
    agree(found[0], {name: first[name] for name in same} | {"turned": gyros})
    assert np.abs(found[1][solution] - first[solution]).max() > 1e-9


@pytest.mark.slow
def test_motors_take_commands(tmp_path: Path):
    """Gimbals of CMGs: those of the flight in Python with the same rates, and with both sets of actuators in use."""
    path = tmp_path / "cmg.fmu"
    changes = {"exposure.frames": 1, "exposure.first": "1 s"}
    scene = skysim.load_scene("simsat_cmg", changes)
    fmu.write_unit(path, scene)
    host = Host(path, tmp_path / "unit")
    host.initialize()
    gimbals = len(host.get("true.gimbal_rad"))
    rates = np.linspace(0.1, 0.3, gimbals)
    host.set("cmgs", *rates)
    host.set("cmgs_given", True)
    host.set("ideal", 0.01, 0, 0)
    host.set("ideal_given", True)
    with Flight(build_lab(scene)) as flight:
        for _ in range(30):
            host.unit.doStep(flight.now_s, 1 / scene.control_rate_hz)
            flight.step(motors={"cmgs": rates, "ideal": np.array([0.01, 0, 0])})
        state = flight.state
    agree(
        host.outputs(),
        {
            "true.gimbal_rad": state.gimbal_rad,
            "true.rate_body_rad_s": state.rate_body_rad_s,
        },
    )
    assert np.abs(state.gimbal_rad).min() > 0.01
    host.unit.freeInstance()


@pytest.mark.slow
def test_a_tool_runs_the_unit_by_its_defaults(bump: Path):
    """As `fmpy simulate` does, without inputs: the scene's own motion."""
    name = "true.lab_from_body_xyzw"
    result = fmpy.simulate_fmu(
        str(bump), stop_time=0.4, output_interval=PERIOD_S, output=[name]
    )
    with Flight(build_lab(skysim.load_scene("simsat_bump"))) as flight:
        for _ in range(40):
            flight.step()
        wanted = flight.state.lab_from_body.as_quat()
    assert len(result) == 41
    assert result[name][-1] == pytest.approx(wanted, abs=1e-12)


@pytest.mark.slow
def test_misuse_is_an_error_with_a_message(host: Host):
    """Each is refused, says what is allowed, and leaves a unit that a reset makes whole."""

    def refused(message: str, call: Any, *arguments: Any) -> None:
        with pytest.raises(fmpy.fmi1.FMICallException):
            call(*arguments)
        assert message in host.messages[-1]

    step = host.unit.doStep
    begin = host.unit.enterInitializationMode
    torque = host.variables["torque_nm"].valueReference
    refused("the unit is not initialized", step, 0.0, PERIOD_S)
    refused("start time: 1 s; allowed: 0", begin, None, 1.0)
    host.initialize()
    refused("parameters before the first step", host.set, "seed", 3)
    refused("there is none of this type", host.unit.getInt64, [0], 1)
    refused("too few are left", host.unit.getFloat64, [torque], 1)
    refused("allowed: multiples of the control period, 0.01", step, 0.0, 0.015)
    refused("allowed: 0 s, where the unit is", step, 0.5, PERIOD_S)
    refused("a function that this unit does not have", host.unit.getFMUState)
    exposure = "main.exposure_s: 0.6 s; allowed: above 0, up to 0.5 s"
    for name, values, message in (
        ("torque_nm", (math.nan, 0, 0), "torque_nm"),
        ("main.exposure_s", (0.6,), exposure),
    ):
        host.unit.reset()
        host.initialize()
        host.set("torque_nm_given", True)
        host.set(name, *values)
        refused(message, step, 0.0, PERIOD_S)
        refused("has failed", step, 0.0, PERIOD_S)
    host.unit.reset()
    host.initialize()
    step(0.0, PERIOD_S)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("python", "message"),
    [("false", "laboratory has ended"), ("no_such_python", "SKYSIM_PYTHON may name")],
)
def test_a_process_that_ends_or_cannot_start_is_an_error(
    bump: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, python: str, message: str
):
    """Not a host that waits, or ends with it."""
    monkeypatch.setenv("SKYSIM_PYTHON", python)
    host = Host(bump, tmp_path)
    with pytest.raises(fmpy.fmi1.FMICallException):
        host.initialize()
    assert message in host.messages[-1]
    host.unit.freeInstance()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simsat_cmg", "two_heads", "simsat_thrusters"])
def test_descriptions_are_valid(name: str, tmp_path: Path):
    """By fmpy's checks, which include the schema of FMI 3.0; variables are those that the scene has."""
    path = tmp_path / "one.fmu"
    fmu.write_unit(path, skysim.load_scene(name))
    assert validation.validate_fmu(str(path)) == []
    variables = fmpy.read_model_description(str(path)).modelVariables
    assert all(one.description for one in variables)
    names = [one.name for one in variables]
    has_motors = name != "two_heads"
    assert ("cmgs" in names) == ("true.gimbal_rad" in names) == (name == "simsat_cmg")
    assert ("thrusters" in names) == ("true.propellant_kg" in names) == ("thrusters" in name)
    # Its motion is prescribed.
    assert ("torque_nm" in names) == has_motors
    assert ("side.solved" in names) != has_motors


def test_a_scene_that_was_changed_is_refused(tmp_path: Path):
    scene = skysim.load_scene("simsat_bump")
    with pytest.raises(InputError, match=r"not as skysim\.load_scene returned it"):
        fmu.write_unit(tmp_path / "x.fmu", scene.model_copy(update={"seed": 8}))


C_HOST = r"""
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include "fmi3FunctionTypes.h"

static void say(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String text) {
    fprintf(stderr, "%s\n", text);
}

static void check(fmi3Status status) {
    if (status != fmi3OK)
        exit(1);
}

int main(int count, char **words) {
    void *library = dlopen(words[1], RTLD_NOW | RTLD_LOCAL);
    if (!library)
        return 2;
    fmi3InstantiateCoSimulationTYPE *instantiate = dlsym(library, "fmi3InstantiateCoSimulation");
    fmi3EnterInitializationModeTYPE *enter = dlsym(library, "fmi3EnterInitializationMode");
    fmi3ExitInitializationModeTYPE *leave = dlsym(library, "fmi3ExitInitializationMode");
    fmi3DoStepTYPE *step = dlsym(library, "fmi3DoStep");
    fmi3GetFloat64TYPE *get = dlsym(library, "fmi3GetFloat64");
    fmi3TerminateTYPE *terminate = dlsym(library, "fmi3Terminate");
    fmi3FreeInstanceTYPE *release = dlsym(library, "fmi3FreeInstance");
    fmi3Instance unit = instantiate("one", words[2], words[3], fmi3False, fmi3False, fmi3False, fmi3False, NULL, 0,
                                    NULL, say, NULL);
    if (!unit)
        return 3;
    check(enter(unit, fmi3False, 0, 0, fmi3False, 0));
    check(leave(unit));
    for (int k = 0; k < 50; k++) {
        fmi3Boolean event, end, early;
        fmi3Float64 reached_s;
        check(step(unit, k * 0.01, 0.01, fmi3True, &event, &end, &early, &reached_s));
    }
    fmi3ValueReference rate = (fmi3ValueReference)atoi(words[4]);
    fmi3Float64 values[3];
    check(get(unit, &rate, 1, values, 3));
    printf("%.17g %.17g %.17g\n", values[0], values[1], values[2]);
    check(terminate(unit));
    release(unit);
    return 0;
}
"""


@pytest.mark.slow
def test_a_host_in_c_runs_the_unit(bump: Path, tmp_path: Path):
    """No Python in the host: fifty periods, whose last rate is that of the flight in Python.

    Its environment has libraries and a Python of its own, as that of Matlab, which the unit's process must not get.
    """
    folder = Path(fmpy.extract(str(bump), str(tmp_path / "unit")))
    description = fmpy.read_model_description(str(bump))
    names = [one.name for one in description.modelVariables]
    (tmp_path / "host.c").write_text(C_HOST)
    headers = Path(pythonfmu3.__file__).parent / "pythonfmu-export" / "src" / "fmi"
    program = str(tmp_path / "host")
    compiler = shutil.which("cc") or "cc"
    subprocess.run(
        [compiler, f"-I{headers}", str(tmp_path / "host.c"), "-o", program, "-ldl"],
        check=True,
    )
    library = next((folder / "binaries").rglob("*.so"))
    words = [library, description.instantiationToken, folder / "resources"]
    done = subprocess.run(
        [program, *map(str, words), str(names.index("true.rate_body_rad_s"))],
        capture_output=True,
        text=True,
        check=True,
        env={"PATH": "", "LD_LIBRARY_PATH": "/nowhere", "PYTHONHOME": "/nowhere"},
    )
    with Flight(build_lab(skysim.load_scene("simsat_bump"))) as flight:
        for _ in range(50):
            flight.step()
        wanted = flight.state.rate_body_rad_s
    assert [float(one) for one in done.stdout.split()] == pytest.approx(wanted, abs=1e-12)


def test_every_kind_of_actuators_has_its_texts() -> None:
    """A kind that is added without them would end the export of each scene that has it."""
    texts = yaml.safe_load((fmu.SOURCES / "variables.yaml").read_text(encoding="utf-8"))
    assert {"ideal", *(kind.key for kind in model.KINDS)} <= set(texts["variables"])
    assert {unit for unit, _ in texts["variables"].values() if unit} <= set(texts["units"])
