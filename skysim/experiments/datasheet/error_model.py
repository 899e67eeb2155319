"""Attitude errors of a star tracker from the constants of its datasheet, without frames. Needs NumPy alone.

The errors about the camera's axes x, y (across the boresight) and z (about it) at the time k are

    e_k = bias + s_k (field f_k + pixel p_k + noise(rate) n_k + along(rate) m_k u),      s_k^2 of mean 1,

with white noise n and m, and the axis u of the rate across the boresight (a streak's centroid errs more along the
streak, and so the attitude errs more about the axis of the motion). f and p are Gauss-Markov processes of the angle
that the boresight has turned, each with a correlation angle. s is the scale of the field: a lognormal process of that
angle, since a field with few stars errs more. At rest f, p and s are constant. bias is the mean plus the draws of
the unit and of its thermal state, which stays. All are independent; the scale is common to the axes. The constants were
measured from rest to the last of their rates, and a faster rate is refused.

    model = ErrorModel.read("tracker_error.json")
    errors_arcsec = model.draw(rate_deg_s, step_s, np.random.default_rng(1))     # (N, 3)
"""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import numpy as np

AXES = ("x", "y", "roll")
PROCESSES = ("field", "pixel", "scale")  # of the angle that the boresight has turned


class State(NamedTuple):
    """What is kept from one time to the next: standard normal numbers, the unit's bias and the axis of the rate.

    Attributes
    ----------
    field, pixel
        (3,) standard normal
    scale
        Standard normal
    bias
        (3,) arcseconds
    axis_rad
        Angle of the axis from x toward y
    """

    field: Any
    pixel: Any
    scale: float
    bias: Any
    axis_rad: float


class ErrorModel:
    """Constants of one tracker.

    Attributes
    ----------
    constants
        mean, unit, thermal, field, pixel (of x, y, roll: arcseconds, 1 sigma); scale (of x, y,
        roll: standard deviation of the logarithm of the variance); field_deg, pixel_deg,
        scale_deg (correlation angles); rates_deg_s, noise (for each rate: of x, y, roll in
        arcseconds) and along (for each rate: what is added about its axis, arcseconds), both
        linear between the rates
    """

    mean: Any
    unit: Any
    thermal: Any
    field: Any
    pixel: Any
    scale: Any
    rates_deg_s: Any
    noise: Any
    along: Any

    def __init__(self, constants: dict[str, Any]) -> None:
        self.constants = constants
        for name in ErrorModel.__annotations__:
            setattr(self, name, np.array(constants[name], dtype=float))

    @classmethod
    def read(cls, path: Any) -> ErrorModel:
        """The model of a JSON file."""
        with open(path, encoding="utf-8") as file:
            return cls(json.load(file))

    def start(self, rng: Any, unit: bool = True) -> State:
        """The state of a new unit in a random field, turning about a random axis across the boresight.

        Parameters
        ----------
        unit
            Whether its bias is drawn; otherwise it is the mean of all units and thermal states
        """
        scatter = np.hypot(self.unit, self.thermal)
        bias = self.mean + (scatter * rng.standard_normal(3) if unit else 0.0)
        axis_rad = float(rng.uniform(0, 2 * math.pi))
        return State(
            rng.standard_normal(3),
            rng.standard_normal(3),
            float(rng.standard_normal()),
            bias,
            axis_rad,
        )

    def measured_rates(self, rate_deg_s: Any) -> Any:
        """(N,) magnitudes of rates in degrees per second. Raises ValueError for one beyond those that were measured."""
        rates = np.atleast_1d(np.abs(np.asarray(rate_deg_s, dtype=float)))
        unmeasured = rates[~(rates <= self.rates_deg_s[-1])]
        if unmeasured.size:
            raise ValueError(
                f"rate_deg_s: {unmeasured[0]:g} deg/s; allowed: up to {self.rates_deg_s[-1]:g} deg/s, as measured"
            )
        return rates

    def noise_arcsec(self, rate_deg_s: Any) -> Any:
        """(N, 3) standard deviation of the noise at (N,) rates, without what is added about the rate's axis."""
        return np.stack(
            [np.interp(rate_deg_s, self.rates_deg_s, column) for column in self.noise.T],
            axis=-1,
        )

    def along_arcsec(self, rate_deg_s: Any) -> Any:
        """(N,) standard deviation of what is added about the rate's axis."""
        return np.interp(rate_deg_s, self.rates_deg_s, self.along)

    def drawn_noise(self, rate_deg_s: Any, axis_rad: Any, rng: Any) -> Any:
        """(N, 3) temporal noise at (N,) rates about an axis, or one for each."""
        noise = self.noise_arcsec(rate_deg_s) * rng.standard_normal((len(rate_deg_s), 3))
        along = self.along_arcsec(rate_deg_s) * rng.standard_normal(len(rate_deg_s))
        noise[:, 0] += along * np.cos(axis_rad)
        noise[:, 1] += along * np.sin(axis_rad)
        return noise

    def draw(
        self,
        rate_deg_s: Any,
        step_s: float,
        rng: Any,
        state: State | None = None,
        axis_rad: Any | None = None,
    ) -> Any:
        """(N, 3) errors in arcseconds, at times step_s apart.

        Parameters
        ----------
        rate_deg_s
            (N,) rate of the boresight; from one time to the next it turns by rate times step
        state
            State at the first time; that of a new unit in a random field if left out
        axis_rad
            Angle of the rate's axis from the camera's x toward y, or (N,) angles; that of the
            state if left out
        """
        rate = self.measured_rates(rate_deg_s)
        first = self.start(rng) if state is None else state
        if axis_rad is None:
            axis_rad = first.axis_rad
        walked = self.walk(first, rate * step_s, rng)
        return self.errors(first.bias, walked, self.drawn_noise(rate, axis_rad, rng))

    def step(
        self, state: State, rate_deg_s: float, step_s: float, rng: Any
    ) -> tuple[State, Any]:
        """The state one step later, and its (3,) errors in arcseconds."""
        rate = self.measured_rates(rate_deg_s)
        walked = [one[1] for one in self.walk(state, np.append(0.0, rate * step_s), rng)]
        noise = self.drawn_noise(rate, state.axis_rad, rng)[0]
        later = state._replace(**dict(zip(PROCESSES, walked, strict=True)))
        return later, self.errors(state.bias, walked, noise)

    def walk(self, first: State, turned_deg: Any, rng: Any) -> list[Any]:
        """The PROCESSES at N times from a state on, before each of which the boresight turns by (N,) angles."""
        return [
            correlated(turned_deg / self.constants[f"{name}_deg"], getattr(first, name), rng)
            for name in PROCESSES
        ]

    def errors(self, bias: Any, walked: list[Any], noise: Any) -> Any:
        """(N, 3) errors of the equation above, (3,) at one time, from its PROCESSES."""
        field, pixel, scale = walked
        slow = self.field * field + self.pixel * pixel
        return bias + self.scales(scale) * (slow + noise)

    def correlation(self, angle_deg: float, rate_deg_s: float) -> Any:
        """(3,) correlation of two errors of one unit at a rate, between which the boresight turns by an angle.

        It is the mean over all axes of the rate: x and y each have half of the variance that is added about the axis.

        E[s_k s_l] = exp(-v^2 (1 - r) / 4) for lognormal scales whose normal numbers have the correlation r.
        """
        field, pixel, scale = (
            math.exp(-abs(angle_deg) / self.constants[f"{name}_deg"]) for name in PROCESSES
        )
        rate = self.measured_rates(rate_deg_s)
        noise = self.noise_arcsec(rate)[0]
        shared = self.field**2 * field + self.pixel**2 * pixel
        along = self.along_arcsec(rate) ** 2 / 2 * np.array([1.0, 1.0, 0.0])
        total = self.field**2 + self.pixel**2 + noise**2 + along
        return np.exp(-(self.scale**2) * (1 - scale) / 4) * shared / total

    def scales(self, normal: Any) -> Any:
        """(N, 3) scales of standard normal numbers, (3,) of one: s^2 = exp(v q - v^2 / 2) has the mean 1."""
        return np.exp(0.5 * (np.multiply.outer(normal, self.scale) - self.scale**2 / 2))


def correlated(steps: Any, first: Any, rng: Any) -> Any:
    """(N, ...) Gauss-Markov process x_k = c_k x_(k-1) + sqrt(1 - c_k^2) n_k from x_0 = first, c_k = exp(-steps_k).

    The recursion is composed in log2 N passes over the array (Hillis & Steele 1986), without a loop over the times.
    """
    shape = (len(steps), *np.shape(first))
    left = np.exp(-np.asarray(steps)).reshape(-1, *[1] * np.ndim(first))
    values = np.sqrt(1 - left**2) * rng.standard_normal(shape)
    values[0] = first
    left[0] = 0.0
    shift = 1
    while shift < len(values) and left.any():
        values[shift:] += left[shift:] * values[:-shift]
        left[shift:] *= left[:-shift].copy()
        shift *= 2
    return values
