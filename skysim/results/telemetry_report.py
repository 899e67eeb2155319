"""Summary, tables and plots of a run's telemetry: true motion, estimates, commands and actuator states."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_DEG, ARCSEC_RAD, RPM_RAD_S
from skysim.core.types import Floats, Record, Telemetry, lengths
from skysim.dynamics.imu import Increments, tilt_rad
from skysim.results.plots import figure_png, stacked_axes
from skysim.simulation.motion import at_limit, saturation_text

# A vehicle that is farther from its commanded attitude for longer is warned of; after a step or a knock it returns.
MAX_OFF_DEG = 2.0
MAX_OFF_S = 5.0
AXES = ("x", "y", "z")
EULER = ("roll", "pitch", "yaw")


def euler_deg(lab_from_body: Rotation) -> Floats:
    """(..., 3) roll, pitch, yaw in degrees: lab_from_body = Rz(yaw) Ry(pitch) Rx(roll)."""
    return lab_from_body.as_euler("ZYX", degrees=True)[..., ::-1]


def attitude_error_deg(attitude: Rotation | None, truth: Rotation) -> Floats | None:
    """(K,) rotation angle between an estimated or commanded attitude and the truth, degrees; None for None."""
    return None if attitude is None else np.degrees((attitude.inv() * truth).magnitude())


def per_hour(rate_rad_s: Floats) -> Floats:
    """Convert rad/s to deg/h."""
    return np.degrees(rate_rad_s) * 3600


def summary(log: Telemetry) -> dict[str, float]:
    """Worst and final values of the recorded quantities; units are in the names.

    Only the entries that the telemetry supports are present: pointing error with a reference attitude, wheel speed
    with wheels, and so on.
    """
    pointing, imu, by_filter = (
        attitude_error_deg(one, log.lab_from_body)
        for one in (log.lab_from_ref, log.lab_from_imu, log.lab_from_filter)
    )
    statistics: Record = {}
    if pointing is not None:
        statistics |= {"pointing_deg_worst": pointing.max(), "pointing_deg_end": pointing[-1]}
        statistics["torque_nm_worst"] = np.abs(log.torque_nm).max()
        if log.loads:
            statistics["saturated_s"] = saturated_s(log)
        # A prescribed motion, without a reference, leaves wheels and gimbals as they were.
        if log.wheel_rad_s.size or log.gimbal_rad.size:
            statistics["momentum_nms_worst"] = lengths(log.momentum_nms).max()
        if log.wheel_rad_s.size:
            statistics["wheel_rpm_worst"] = np.abs(log.wheel_rad_s).max() / RPM_RAD_S
        if log.manipulability is not None:
            statistics["manipulability_least"] = log.manipulability.min()
        if "propellant_kg" in log.readings:
            statistics["propellant_g_used"] = 1e3 * np.ptp(log.readings["propellant_kg"])
    if imu is not None and log.saturated is not None:
        statistics |= {"imu_deg_worst": imu.max(), "imu_deg_end": imu[-1]}
        statistics["gyro_saturated_s"] = log.saturated.sum() * log.period_s
    if (
        by_filter is not None
        and log.assumed_bias_rad_s is not None
        and log.bias_rad_s is not None
    ):
        bias_error = per_hour(log.assumed_bias_rad_s - log.bias_rad_s)[-1]
        statistics["filter_deg_worst"] = by_filter.max()
        statistics["filter_arcsec_end"] = by_filter[-1] / ARCSEC_DEG
        statistics["filter_bias_deg_h_end"] = np.linalg.norm(bias_error)
    for name, mounting in log.mountings.items():
        error_rad = mounting.estimate_rad[-1] - mounting.true_rad[-1]
        statistics[f"mounting_{name}_arcsec_end"] = np.linalg.norm(error_rad) / ARCSEC_RAD
    return {name: float(value) for name, value in statistics.items()}


def saturated_s(log: Telemetry, since_s: float = 0.0) -> float:
    """Time during which any actuator of the controller was at its limit, from a time on."""
    full = np.array([*at_limit(log.loads).values(), np.zeros(len(log.t_s), dtype=bool)])
    return float(full[:, log.t_s >= since_s].any(axis=0).sum() * log.period_s)


def findings(log: Telemetry) -> list[str]:
    """Warnings after a flight: actuators at their limits, and a vehicle that was far from its commanded attitude."""
    found = [saturation_text(log.t_s, log.loads)]
    pointing = attitude_error_deg(log.lab_from_ref, log.lab_from_body)
    if pointing is not None and (pointing > MAX_OFF_DEG).sum() * log.period_s > MAX_OFF_S:
        n = int(pointing.argmax())
        found.append(
            f"the vehicle was up to {pointing[n]:.3g}° from its commanded attitude, at {log.t_s[n]:.1f} s"
        )
    return list(filter(None, found))


def components(head: str, values: Floats, ends: Sequence[str] = AXES) -> Record:
    """The columns of (K, N) values, whose heads differ in the word for {}."""
    return {head.format(end): column for end, column in zip(ends, values.T, strict=True)}


def table(log: Telemetry) -> Any:
    """Telemetry as an astropy table, one row per control tick; angles in degrees."""
    from astropy.table import Table

    columns: Record = {"t_s": log.t_s}
    attitudes = {
        "true": log.lab_from_body,
        "commanded": log.lab_from_ref,
        "imu": log.lab_from_imu,
        "filter": log.lab_from_filter,
    }
    for name, attitude in attitudes.items():
        if attitude is not None:
            columns |= components(f"{name}_{{}}_deg", euler_deg(attitude), EULER)
    pointing = attitude_error_deg(log.lab_from_ref, log.lab_from_body)
    if pointing is not None:
        columns["pointing_error_deg"] = pointing
    columns |= components("rate_{}_deg_s", np.degrees(log.rate_body_rad_s))
    columns |= components("torque_{}_nm", log.torque_nm)
    columns |= components("disturbance_{}_nm", log.disturbance_nm)
    columns |= components("momentum_{}_nms", log.momentum_nms)
    columns |= components("{}_rpm", log.wheel_rad_s / RPM_RAD_S, log.wheel_names)
    columns |= components("{}_deg", np.degrees(log.gimbal_rad), log.gimbal_names)
    columns |= {f"load_{name}": load for name, load in log.loads.items()}
    for name, values in log.readings.items():
        for n, column in enumerate(values.reshape(len(values), -1).T):
            columns[f"{name}_{n + 1}" if values.ndim > 1 else name] = column
    if log.manipulability is not None:
        columns["manipulability"] = log.manipulability
    if log.saturated is not None:
        columns["gyro_saturated"] = log.saturated
    biases = {
        "bias": log.bias_rad_s,
        "assumed_bias": log.assumed_bias_rad_s,
        "sigma_bias": log.sigma_bias_rad_s,
    }
    for name, rates in biases.items():
        if rates is not None:
            columns |= components(f"{name}_{{}}_deg_h", per_hour(rates))
    if log.sigma_attitude_rad is not None:
        sigma_arcsec = np.degrees(log.sigma_attitude_rad) / ARCSEC_DEG
        columns |= components("sigma_attitude_{}_arcsec", sigma_arcsec)
    for name, mounting in log.mountings.items():
        for kind, values_rad in zip(("", "sigma_", "true_"), mounting, strict=True):
            head = f"{kind}mounting_{name}_{{}}_arcsec"
            columns |= components(head, values_rad / ARCSEC_RAD)
    return Table(columns)


def imu_table(record: Increments) -> Any:
    """Every IMU sample as an astropy table, for use in a separate attitude filter.

    Columns: angle and velocity increments, and roll and pitch from each accelerometer sample alone.
    """
    from astropy.table import Table

    columns: Record = {"t_s": record.t_s}
    columns |= components("angle_{}_rad", record.angle_rad)
    columns |= components("velocity_{}_m_s", record.velocity_m_s)
    level_deg = np.degrees([tilt_rad(velocity[None]) for velocity in record.velocity_m_s])
    columns["level_roll_deg"], columns["level_pitch_deg"] = level_deg.T
    columns["gyro_saturated"] = record.saturated
    columns["accelerometer_overloaded"] = record.overloaded
    return Table(columns)


def attitude_panel(log: Telemetry, axes: Any) -> None:
    axes.plot(log.t_s, euler_deg(log.lab_from_body), label=EULER)
    if log.lab_from_ref is not None:
        axes.set_prop_cycle(None)  # the same three colors again
        axes.plot(log.t_s, euler_deg(log.lab_from_ref), "--", alpha=0.6, lw=1)
    axes.set_ylabel("attitude [deg]\n(dashed: commanded)")


def attitude_error_panel(log: Telemetry, axes: Any) -> None:
    curves = (
        ("command", log.lab_from_ref, "0.6"),
        ("IMU alone", log.lab_from_imu, "tab:red"),
        ("filter", log.lab_from_filter, "tab:green"),
    )
    for name, attitude, color in curves:
        error_deg = attitude_error_deg(attitude, log.lab_from_body)
        if error_deg is not None:
            axes.semilogy(log.t_s, np.maximum(error_deg, 1e-7), color=color, label=name)
    if log.sigma_attitude_rad is not None:
        sigma_deg = np.degrees(lengths(log.sigma_attitude_rad))
        axes.semilogy(log.t_s, 3 * sigma_deg, ":", color="tab:green", label="filter 3σ")
    if log.saturated is not None and log.saturated.any():
        low, high = axes.get_ylim()
        axes.fill_between(
            log.t_s, low, high, where=log.saturated, color="tab:red", alpha=0.25, lw=0
        )
        axes.set_ylim(low, high)
    axes.set_ylabel("error [deg]")


def draw_estimate(
    axes: Any,
    t_s: Floats,
    true: Floats,
    estimate: Floats,
    sigma: Floats,
    prefix: str = "",
    color: int = 0,
) -> None:
    """Draw the three components of an estimate with bands of 3 sigma, and the true ones dashed.

    Parameters
    ----------
    true, estimate, sigma
        (K, 3)
    prefix
        Text before the axis in the legend
    color
        Number of the first component's color
    """
    for n, axis in enumerate(AXES):
        style = {"color": f"C{color + n}"}
        axes.plot(t_s, true[:, n], "--", lw=1, **style)
        axes.plot(t_s, estimate[:, n], label=prefix + axis, **style)
        low = estimate[:, n] - 3 * sigma[:, n]
        high = estimate[:, n] + 3 * sigma[:, n]
        axes.fill_between(t_s, low, high, alpha=0.12, lw=0, **style)


def bias_panel(log: Telemetry, axes: Any) -> None:
    rates: Any = (log.bias_rad_s, log.assumed_bias_rad_s, log.sigma_bias_rad_s)
    true, estimate, sigma = map(per_hour, rates)
    draw_estimate(axes, log.t_s, true, estimate, sigma)
    settled = sigma[len(sigma) // 4 :]
    limit = max(np.abs(true).max(), np.abs(estimate).max()) + 3 * settled.max()
    axes.set_ylim(-limit, limit)
    axes.set_ylabel("gyro bias [deg/h]\n(dashed: true, band: 3σ)")


def mounting_panel(log: Telemetry, axes: Any) -> None:
    late = []
    for n, (name, mounting) in enumerate(log.mountings.items()):
        estimate, sigma, true = (values / ARCSEC_RAD for values in mounting)
        draw_estimate(axes, log.t_s, true, estimate, sigma, f"{name} ", 3 * n)
        late += [values[len(log.t_s) // 4 :] for values in (estimate, sigma, true)]
    limit = np.abs(late).max() * 1.3
    axes.set_ylim(-limit, limit)
    axes.set_ylabel("mounting [arcsec]\n(dashed: true, band: 3σ)")


def torque_panel(log: Telemetry, axes: Any) -> None:
    axes.plot(log.t_s, log.torque_nm, label=AXES)
    axes.set_ylabel("commanded torque\n[N m]")


def wheels_panel(log: Telemetry, axes: Any) -> None:
    names = [f"wheel {n + 1}" for n in range(log.wheel_rad_s.shape[1])]
    axes.plot(log.t_s, log.wheel_rad_s / RPM_RAD_S, label=names)
    axes.set_ylabel("wheels [rpm]")


def gimbals_panel(log: Telemetry, axes: Any) -> None:
    names = [f"gimbal {n + 1}" for n in range(log.gimbal_rad.shape[1])]
    axes.plot(log.t_s, np.degrees(log.gimbal_rad), label=names)
    axes.set_ylabel("gimbals [deg]")
    if log.manipulability is not None:
        right = axes.twinx()
        right.plot(log.t_s, log.manipulability, color="0.5", ls=":")
        right.set_ylim(0, 1)
        right.set_ylabel("manipulability (dotted)")


def momentum_panel(log: Telemetry, axes: Any) -> None:
    axes.plot(log.t_s, log.momentum_nms, label=AXES)
    norm_nms = lengths(log.momentum_nms)
    axes.plot(log.t_s, norm_nms, color="k", lw=1, label="norm")
    axes.set_ylabel("stored momentum\n[N m s]")


def panels(log: Telemetry) -> list[Callable[[Telemetry, Any], None]]:
    """The panels for which the telemetry has data."""
    controlled = log.lab_from_ref is not None
    available = {
        attitude_panel: True,
        attitude_error_panel: log.lab_from_imu is not None or log.lab_from_ref is not None,
        bias_panel: log.lab_from_filter is not None,
        mounting_panel: log.mountings,
        torque_panel: controlled,
        wheels_panel: controlled and log.wheel_rad_s.size,
        gimbals_panel: controlled and log.gimbal_rad.size,
        momentum_panel: controlled and (log.wheel_rad_s.size or log.gimbal_rad.size),
    }
    return [panel for panel, present in available.items() if present]


def figure(log: Telemetry) -> bytes:
    """Telemetry against time, as PNG."""
    shown = panels(log)
    fig, stack = stacked_axes([2.1] * len(shown))
    for panel, axes in zip(shown, stack, strict=True):
        panel(log, axes)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper right", ncols=4, fontsize="small")
    return figure_png(fig, dpi=110)
