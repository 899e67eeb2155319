"""Joints, sites and motors of actuators in the MuJoCo model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.types import Floats

UNIT_GEAR = (1, 0, 0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Hinges:
    """Hinge joints of one kind, in the order of their names.

    names        : (n)
    axes         : (3, n) unit axes in body axes, with all joints at zero
    inertia_kg_m2: (n,) about each axis, of all that rotates with it
    qpos, dof    : (n,) indices of angle and speed in qpos and qvel
    motor        : (n,) actuator numbers, -1 without one
    """

    names: tuple[str, ...]
    axes: Floats
    inertia_kg_m2: Floats
    qpos: NDArray[np.int64]
    dof: NDArray[np.int64]
    motor: NDArray[np.int64]

    @classmethod
    def from_model(cls, model: Any, prefix: str) -> Hinges:
        """All joints whose name begins with prefix."""
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        names = sorted(
            name for name in all_names(model.joint, model.njnt) if name.startswith(prefix)
        )
        ids = np.array([model.joint(name).id for name in names], dtype=np.int64)
        dof = model.jnt_dofadr[ids].astype(np.int64)
        actuators = all_names(model.actuator, model.nu)
        motor = [actuators.index(name) if name in actuators else -1 for name in names]
        return cls(
            tuple(names),
            data.xaxis[ids].T.copy(),
            full[dof, dof],
            model.jnt_qposadr[ids].astype(np.int64),
            dof,
            np.array(motor, dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.names)


def all_names(element: Any, count: int) -> list[str]:
    """Names of a compiled model's elements of one kind; `element` is its accessor by number."""
    return [element(k).name for k in range(count)]


def joints(spec: Any, prefix: str) -> list[Any]:
    """The joints of a spec whose name begins with prefix, in the order of their names."""
    return sorted(
        (j for j in spec.joints if j.name.startswith(prefix)), key=lambda joint: joint.name
    )


def sites(spec: Any, prefix: str) -> list[Any]:
    """The sites of a spec whose name begins with prefix, in the order of their names."""
    return sorted(
        (site for site in spec.sites if site.name.startswith(prefix)), key=lambda site: site.name
    )


def add_motor(
    spec: Any,
    name: str,
    kind: Any,
    target: str,
    limit: float | None = None,
    gear: Sequence[float] = UNIT_GEAR,
) -> Any:
    """Add a motor: force = control, which is limited to +-limit if one is given."""
    motor = spec.add_actuator(name=name, trntype=kind, target=target, gear=gear)
    motor.set_to_motor()
    if limit is not None:
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange = [-limit, limit]
    return motor


def member_values(values: tuple[float, ...], count: int, key: str) -> Floats:
    """One value for each of `count` members; zeros if none are given. Raises InputError for another count."""
    if values and len(values) != count:
        raise InputError(key, f"{len(values)} values", f"{count}, one for each, or none")
    return np.array(values or (0.0,) * count)
