"""Facts and warnings about the vehicle of a plan: mass properties, actuators, and the maneuver beside the exposures."""

import math
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skysim.core.constants import RPM_RAD_S
from skysim.core.types import Floats, Record
from skysim.core.units import significant
from skysim.dynamics.multibody.model import PREFIXES
from skysim.simulation.checks.sampling import Plan
from skysim.simulation.motion import TorqueForecast

MAX_MANEUVERS = 12  # number of maneuvers that are printed
CLOSE_NAME = 0.6  # likeness from which a joint's name was meant for an actuator


def short(value: float, digits: int = 3) -> str:
    """A number as text with this number of significant digits and without an exponent."""
    return f"{float(f'{value:.{digits}g}'):.10g}"


class Fact(NamedTuple):
    """One fact: its name, its text in lines, and its numbers by name."""

    name: str
    lines: list[str]
    values: Record


def numbers(values: Any, digits: int) -> str:
    """Components of a vector with commas; 0 for those below the last digit of the largest one."""
    return ", ".join(short(one, digits) for one in significant(np.atleast_1d(values), digits))


def mass_properties(plan: Plan) -> Fact:
    """Mass, inertia about the bearing's center and center of mass, each with its origin: the scene or the model."""
    vehicle = plan.lab.vehicle
    config = vehicle.config
    mass = vehicle.mass
    quantities = (
        ("mass_kg", mass.mass_kg, "{} kg", 1.0),
        ("inertia_kg_m2", mass.inertia_kg_m2.diagonal(), "inertia {} kg m²", 1.0),
        ("center_of_mass_m", mass.center_m, "center of mass {} mm", 1e3),
    )
    texts = []
    values = Record()
    for key, number, text, scale in quantities:
        origin = Path(config.model).name if getattr(config, key) is None else "scene"
        texts.append(f"{text.format(numbers(scale * number, 4))} ({origin})")
        values |= {key: np.asarray(number).tolist(), f"{key}_of": origin}
    return Fact("vehicle", [", ".join(texts)], values)


def actuators(plan: Plan) -> Fact | None:
    """The actuators that are switched on: names, axes in body axes, limits, and greatest momentum."""
    vehicle = plan.lab.vehicle
    config = vehicle.config
    rows: list[tuple[str, str, Any, Floats | None]] = []
    if wheels := config.wheels:
        spun = vehicle.wheels.inertia_kg_m2 * wheels.speed_limit_rpm
        rows.append(("wheels", f"{short(wheels.torque_limit_nm)} N m", vehicle.wheels, spun))
    if cmgs := config.cmgs:
        spun = vehicle.rotors.inertia_kg_m2 * cmgs.rotor_rpm
        limit = f"{short(cmgs.gimbal_rate_limit_deg_s)} deg/s"
        rows.append(("cmgs", limit, vehicle.gimbals, spun))
    if fans := config.fans:
        rows.append(("fans", f"{short(fans.thrust_limit_n)} N", vehicle.fans, None))
    if thrusters := config.thrusters:
        limit = f"{short(thrusters.thrust_n)} N"
        rows.append(("thrusters", limit, vehicle.thrusters, None))
    if trim := config.trims or config.trim:
        rows.append(("trim", f"{short(1e3 * trim.travel_m)} mm", vehicle.trims, None))
    lines = []
    values = Record()
    for key, limit, members, spun_rpm in rows:
        values[key] = {"names": list(members.names), "axes": members.axes.T.tolist()}
        texts = [f"along ({numbers(axis, 3)})" for axis in members.axes.T]
        if spun_rpm is not None:
            momentum_nms = (spun_rpm * RPM_RAD_S).tolist()
            values[key]["momentum_nms"] = momentum_nms
            texts = [
                f"about ({numbers(axis, 3)}), {short(one)} N m s"
                for axis, one in zip(members.axes.T, momentum_nms, strict=True)
            ]
        parts = map(" ".join, zip(members.names, texts, strict=True))
        lines.append(f"{key} to {limit} each: {'; '.join(parts)}")
    control = plan.scene.motion.control
    if control is not None and control.actuators == "ideal":
        lines.append(f"ideal torques to {short(config.torque_limit_nm)} N m about each axis")
        values["ideal"] = {"torque_limit_nm": config.torque_limit_nm}
    return Fact("actuators", lines, values) if lines else None


def propellant(plan: Plan, forecast: TorqueForecast | None) -> tuple[Fact | None, str]:
    """The propellant that the thrusters need for the maneuver, and a warning if the tank has less."""
    config = plan.lab.vehicle.config.thrusters
    if not (config and forecast and forecast.propellant_kg):
        return None, ""
    grams = [short(1e3 * one) for one in (forecast.propellant_kg, config.propellant_kg)]
    text = f"the maneuver needs {' of '.join(grams)} g"
    values = {"needed_kg": forecast.propellant_kg, "propellant_kg": config.propellant_kg}
    warning = f"vehicle.thrusters.propellant: {text}; change it to a slower or smaller one, or take more"
    is_short = forecast.propellant_kg > config.propellant_kg
    return Fact("propellant", [text], values), warning if is_short else ""


def maneuver(plan: Plan) -> Fact | None:
    """Start and end of each maneuver, and of the exposures; None without a maneuver."""
    lab = plan.lab
    maneuvers = lab.scene.motion.maneuver
    if not maneuvers:
        return None
    exposure = lab.scene.exposure
    start_s = lab.reference.start_s
    rows = [
        {"kind": element.kind, "begin_s": begin_s, "end_s": end_s}
        for element, begin_s, end_s in zip(maneuvers, start_s, start_s[1:], strict=False)
    ]
    parts = [f"{row['kind']} {row['begin_s']:.4g} to {row['end_s']:.4g} s" for row in rows]
    more = f", {len(parts) - MAX_MANEUVERS} more" if len(parts) > MAX_MANEUVERS else ""
    lines = [
        f"{', '.join(parts[:MAX_MANEUVERS])}{more}; exposures from {exposure.first_s:.4g} to {lab.duration_s:.4g} s"
    ]
    if start_s[-1] > lab.duration_s + 1 / exposure.rate_hz:
        frames = math.ceil((start_s[-1] - exposure.first_s) * exposure.rate_hz) + 1
        lines.append(
            f"the exposures end at {lab.duration_s:.1f} s; the maneuver lasts {start_s[-1]:.1f} s:"
            f" exposure.frames {frames} would show it all"
        )
    values = {"maneuvers": rows, "exposures_s": [exposure.first_s, lab.duration_s]}
    return Fact("maneuver", lines, values)


def inherited_vehicle(plan: Plan) -> str:
    """Warn if keys about the vehicle's body are those of a base scene with another vehicle."""
    inherited = ", ".join(plan.scene.inherited)
    if not inherited:
        return ""
    return f"vehicle.model: not that of the base, whose {inherited} the vehicle keeps; give its own"


def free_joints(plan: Plan) -> str:
    """Warn of joints of the vehicle's file that no actuator drives, with the nearest name that would be one."""
    free = plan.lab.vehicle.free_joints
    if not free:
        return ""
    name = free[0]
    likeness = {
        prefix: SequenceMatcher(None, name[: len(prefix)].lower(), prefix).ratio()
        for prefix in PREFIXES
    }
    nearest = max(likeness, key=likeness.__getitem__)
    change = ""
    if likeness[nearest] > CLOSE_NAME:
        change = f"; change {name} to {nearest}{name[len(nearest) :]}"
    return (
        f"vehicle.model: joint{'s' * (len(free) > 1)} {', '.join(free)}: not the name of an actuator"
        f" ({', '.join(PREFIXES)}), so nothing drives it{change}"
    )


def ignored_parts(plan: Plan) -> str:
    """Warn of actuators and sensors of the vehicle's file, which have no effect."""
    ignored = ", ".join(plan.lab.vehicle.ignored)
    if not ignored:
        return ""
    return f"vehicle.model: {ignored}: not used; those of the scene's section vehicle are; remove them"


FACTS = (
    mass_properties,
    actuators,
    maneuver,
)
FINDINGS = (
    inherited_vehicle,
    free_joints,
    ignored_parts,
)
