"""A laboratory as a unit of co-simulation (FMI 3.0), for Simulink and other tools.

1. `LabUnit` flies a scene: inputs are commands and exposure times, outputs the truth, the IMU, and the solutions.
2. `variables` is the table of its variables, from which model description and program are generated.
3. `write_unit` writes the file. Its program (`data/fmu/laboratory.c`) starts a Python with skysim, which runs
   `data/fmu/laboratory_slave.py`.
"""

import json
import math
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import yaml

from skysim.core import __version__
from skysim.core.errors import InputError
from skysim.core.files import make_folder, write_text
from skysim.core.paths import DATA
from skysim.core.types import ROUNDING, Record
from skysim.scene.loader import keys_of
from skysim.scene.scene import Scene
from skysim.simulation.flight import Flight, Shot
from skysim.simulation.lab import StarCamera, build_lab, longest_live_s

SOURCES = DATA / "fmu"
SLAVE = "laboratory_slave.py"


class UnitVariable(NamedTuple):
    """A variable of the unit.

    Attributes
    ----------
    name, causality
        As in the model description
    start
        Value at the beginning: a bool, an int, a float, or an array of floats
    """

    name: str
    causality: str
    start: Any

    @property
    def code(self) -> str:
        """Type, as `struct` writes it: ? (Boolean), q (Int64) or d (Float64)."""
        return {"b": "?", "i": "q"}.get(np.asarray(self.start).dtype.kind, "d")


class LabUnit:
    """A scene in flight without end, which another program steps. Stateful.

    Attributes
    ----------
    inputs
        Values of the inputs at the beginning, by name
    outputs
        Values of the outputs now, by name
    """

    def __init__(self, scene: Scene) -> None:
        self.lab = build_lab(scene)
        self.begin(scene.seed)

    def begin(self, seed: int) -> None:
        """Begin a flight of the same hardware with this seed."""
        lab = self.lab.in_run(seed)
        self.flight = Flight(lab, endless=True, keeps_history=False)
        self.inputs: Record = {}
        self.outputs: Record = {}
        if not lab.scene.motion.is_prescribed:
            sets = self.flight.motion.flight_computer.actuator_sets
            motors = {key: len(one.motor) for key, one in sets.items()}
            for name, size in {"torque_nm": 3, **motors}.items():
                self.inputs |= {name: np.zeros(size), f"{name}_given": False}
        for camera in lab.cameras:
            self.take_shot(camera, NO_SHOT)
            if not camera.scene.tracker.exposure_control:
                self.inputs[f"{camera.name}.exposure_s"] = camera.scene.exposure.time_s
        self.outputs |= self.increments(0.0)
        self.take_state()

    @property
    def period_s(self) -> float:
        """Control period."""
        return self.flight.motion.flight_computer.period_s

    def step(self, inputs: Record, periods: int) -> None:
        """Simulate some control periods with inputs that are held.

        Raises
        ------
        InputError
            For commands that are not finite, and an exposure time beyond its limits.
        """
        flight = self.flight
        for schedule in flight.schedules:
            self.take_shot(schedule.camera, {"is_new": False})
            key = f"{schedule.camera.name}.exposure_s"
            if key in inputs:
                longest_s = longest_live_s(schedule.camera.scene)
                if not 0 < inputs[key] <= longest_s * (1 + ROUNDING):
                    allowed = f"above 0, up to {longest_s:g} s"
                    raise InputError(key, f"{inputs[key]:g} s", allowed)
                schedule.exposure_control.exposure_s = inputs[key]
        motors = {key: inputs[key] for key in inputs if inputs.get(f"{key}_given")}
        torque_nm = motors.pop("torque_nm", None)
        self.outputs |= self.increments(flight.now_s)
        for _ in range(periods):
            begin_s = flight.now_s
            shots = flight.step(torque_nm, motors)
            # Without a filter a step takes no exposure.
            shots += flight.capture_due(flight.schedules, solves=True)
            for shot in shots:
                self.take_shot(shot.camera, shot_values(shot))
            new = self.increments(begin_s)
            self.outputs |= {name: self.outputs[name] + new[name] for name in new}
        self.take_state()

    def increments(self, begin_s: float) -> Record:
        """What the IMU has measured since a time: sums of its increments; empty without an IMU."""
        samples = self.flight.imu_samples(begin_s)
        if samples is None:
            return {}
        # Half a sample before it: rounding must neither lose a sample nor count it twice.
        new = samples.t_s > begin_s + samples.step_s / 2
        return {
            "imu.angle_rad": samples.angle_rad[new].sum(axis=0),
            "imu.velocity_m_s": samples.velocity_m_s[new].sum(axis=0),
            "imu.samples": new.sum(),
            "imu.saturated": samples.saturated[new].any(),
        }

    def take_shot(self, camera: StarCamera, values: Record) -> None:
        """Take values of a camera's exposure into the outputs."""
        self.outputs |= {f"{camera.name}.{name}": values[name] for name in values}

    def take_state(self) -> None:
        """Take the true state and the attitudes of navigator and filter into the outputs."""
        state = self.flight.state
        values = {
            "t_s": state.t_s,
            "true.lab_from_body_xyzw": state.lab_from_body.as_quat(),
            "true.rate_body_rad_s": state.rate_body_rad_s,
            "true.wheel_rad_s": state.wheel_rad_s,
            "true.gimbal_rad": state.gimbal_rad,
            **{f"true.{name}": reading for name, reading in state.readings.items()},
        }
        navigation = self.flight.motion.navigation
        if navigation:
            values["imu.lab_from_body_xyzw"] = np.roll(navigation.attitude_wxyz("imu"), -1)
        if navigation and navigation.filter:
            values |= {
                "filter.lab_from_body_xyzw": np.roll(navigation.attitude_wxyz("filter"), -1),
                "filter.rate_body_rad_s": navigation.filter.rate_rad_s,
                "filter.sigma_rad": navigation.filter.state.sigma_attitude_rad,
            }
        # An array without values is no variable.
        self.outputs |= {name: one for name, one in values.items() if np.size(one)}


NO_SHOT: Record = {
    "frame": -1,
    "is_new": False,
    "t_mid_s": math.nan,
    "exposed_s": math.nan,
    "solved": False,
    "cam_from_ref_xyzw": np.full(4, math.nan),
    "sigma_rad": np.full(3, math.nan),
    "true_t_mid_s": math.nan,
    "true_cam_from_ref_xyzw": np.full(4, math.nan),
}


def shot_values(shot: Shot) -> Record:
    """The values of `NO_SHOT` for an exposure."""
    attitude = shot.solution.attitude
    values = NO_SHOT | {
        "frame": shot.frame.index,
        "is_new": True,
        "t_mid_s": shot.frame.t_mid_s,
        "exposed_s": shot.frame.exposure_s,
        "solved": attitude.solved,
        "true_t_mid_s": shot.truth.t_s,
        "true_cam_from_ref_xyzw": shot.truth.mean_cam_from_lab.as_quat(),
    }
    if attitude.cam_from_ref is not None:
        values["cam_from_ref_xyzw"] = attitude.cam_from_ref.as_quat()
    if attitude.covariance_rad2 is not None:
        values["sigma_rad"] = np.sqrt(np.diag(attitude.covariance_rad2))
    return values


def variables(unit: LabUnit) -> list[UnitVariable]:
    """The variables of a unit that has just begun; their value references are their indices."""
    starts = unit.inputs | {"seed": unit.lab.scene.seed} | unit.outputs
    causes = {"t_s": "independent", "seed": "parameter"} | dict.fromkeys(unit.inputs, "input")
    return [
        UnitVariable(name, causes.get(name, "output"), start)
        for name, start in starts.items()
    ]


# The file.


def require_builder(key: str) -> None:
    """Raise InputError if the package that describes and builds units is not installed."""
    if find_spec("pythonfmu3") is None:
        raise InputError(
            key, "pythonfmu3 is not installed", "after pip install 'skysim[fmu]'"
        )


def write_unit(path: Path, scene: Scene) -> None:
    """Write a scene as a unit of co-simulation.

    It runs on Linux, with the Python that has written it.

    Raises
    ------
    InputError
        Without pythonfmu3, a C compiler or Linux, and for a scene that was changed after it was loaded.
    """
    require_builder("export.file")
    compiler = shutil.which("cc")
    if platform.system() != "Linux" or compiler is None:
        raise InputError("export.file", f"{path.name} needs Linux and a C compiler, cc")
    import pythonfmu3

    setup = yaml.safe_dump({"path": str(Path(__file__).parents[3]), "scene": keys_of(scene)})
    unit = LabUnit(scene)
    name = re.sub(r"\W|^(?=\d)", "_", scene.name)
    description = describe(unit, name)
    standard = Path(pythonfmu3.__file__).parent / "pythonfmu-export" / "src" / "fmi"
    with tempfile.TemporaryDirectory() as folder:
        header = program_table(unit, description.attrib["instantiationToken"])
        write_text(Path(folder) / "variables.h", header)
        library = f"{folder}/laboratory.so"
        words = [compiler, "-shared", "-fPIC", f"-I{folder}", f"-I{standard}", "-o", library]
        words += [str(SOURCES / "laboratory.c"), "-lm"]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            problem = f"{compiler} failed: {done.stderr.strip()[-300:]}"
            raise InputError("export.file", problem)
        make_folder(path.parent)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            xml = ElementTree.tostring(description, "utf-8", xml_declaration=True)
            archive.writestr("modelDescription.xml", xml)
            archive.write(library, f"binaries/{platform.machine()}-linux/{name}.so")
            archive.write(SOURCES / SLAVE, f"resources/{SLAVE}")
            archive.writestr("resources/laboratory.yaml", setup)


def describe(unit: LabUnit, name: str) -> ElementTree.Element:
    """The model description (XML) of a unit, with the texts of `variables.yaml`."""
    import pythonfmu3
    from pythonfmu3.default_experiment import DefaultExperiment
    from pythonfmu3.unit import Unit
    from pythonfmu3.variables import Dimension

    model = pythonfmu3.Fmi3Slave(instance_name=name)
    model.modelName = name
    model.description = unit.lab.scene.title
    stop_s = math.ceil(unit.lab.duration_s / unit.period_s) * unit.period_s
    model.default_experiment = DefaultExperiment(0.0, stop_s, unit.period_s)
    texts = yaml.safe_load((SOURCES / "variables.yaml").read_text(encoding="utf-8"))
    units = texts["units"]
    model.register_units([Unit(symbol, **units[symbol]) for symbol in units])
    kinds = {"d": pythonfmu3.Float64, "q": pythonfmu3.Int64, "?": pythonfmu3.Boolean}
    for one in variables(unit):
        value = np.asarray(one.start)
        # Without the name of a camera or of a command.
        own = re.sub(r"^\w+(\.|_(?=given$))", "", one.name)
        symbol, description = texts["variables"].get(one.name) or texts["variables"][own]
        variable = kinds[one.code](
            one.name,
            causality=pythonfmu3.Fmi3Causality[one.causality],
            variability={"parameter": pythonfmu3.Fmi3Variability.fixed}.get(one.causality),
            description=description,
            dimensions=[Dimension(str(size)) for size in value.shape],
            getter=value.tolist,
            **({"unit": symbol} if symbol else {}),
        )
        model.register_variable(variable, nested=False)
    xml = model.to_xml()
    xml.set("generationTool", f"skysim {__version__}")
    xml.find("CoSimulation").attrib.update(
        canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=repr(unit.period_s),
    )
    ElementTree.indent(xml)
    return xml


def program_table(unit: LabUnit, token: str) -> str:
    """The header `variables.h` of the unit's program: its variables and the Python that it starts."""
    rows = []
    cells: list[int] = []
    for one in variables(unit):
        rows.append(f"{{'{one.code}', \"{one.causality}\", {np.size(one.start)}}}")
        start = np.array(one.start, float if one.code == "d" else np.int64)
        cells += start.reshape(-1).view(np.uint64).tolist()
    return (
        f'#define TOKEN "{token}"\n'
        f"#define PYTHON {json.dumps(sys.executable)}\n"
        f"#define PERIOD_S {unit.period_s!r}\n"
        f"#define CELLS {len(cells)}\n"
        f"static const Variable VARIABLES[] = {{{', '.join(rows)}}};\n"
        f"static const uint64_t STARTS[CELLS] = {{{', '.join(map(hex, cells))}}};\n"
    )
