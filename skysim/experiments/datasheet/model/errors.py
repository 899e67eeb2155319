"""Attitude errors of a star tracker from the constants of its datasheet, without frames. Needs NumPy alone.

The errors about the camera's axes x, y (across the boresight) and z (about it) at the time k are

    e_k = bias + s_k (field f_k + pixel p_k + noise(rate) n_k),      s_k^2 of mean 1,

n white, f and p Gauss-Markov processes of the angle that the boresight has turned, with a correlation angle each, and
s the scale of the field: a lognormal process of that angle, since a field with few stars errs more. At rest f, p and s
are constant. bias is the mean and the draw of the unit. All are independent; the scale is common to the axes.

    model = ErrorModel.read("tracker_error.json")
    errors_arcsec = model.draw(rate_deg_s, step_s, np.random.default_rng(1))     # (N, 3)
"""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import numpy as np

AXES = ("x", "y", "roll")


class State(NamedTuple):
    """What is kept from one time to the next: standard normal numbers, and the unit's bias in arcseconds.

    field, pixel : (3,);  scale : a number;  bias : (3,)
    """

    field: Any
    pixel: Any
    scale: float
    bias: Any


class ErrorModel:
    """Constants of one tracker.

    constants : mean, unit, field, pixel (x, y, roll: arcseconds, 1 sigma), scale (x, y, roll: standard deviation of the
        logarithm of the variance), field_deg, pixel_deg, scale_deg (correlation angles), rates_deg_s, and noise (for
        each rate x, y, roll in arcseconds; linear between the rates, constant beyond the last)
    """

    def __init__(self, constants: dict[str, Any]) -> None:
        self.constants = constants
        self.mean, self.unit, self.field, self.pixel, self.scale = (
            np.array(constants[name], dtype=float) for name in ("mean", "unit", "field", "pixel", "scale")
        )
        self.rates_deg_s = np.array(constants["rates_deg_s"], dtype=float)
        self.noise = np.array(constants["noise"], dtype=float)

    @classmethod
    def read(cls, path: Any) -> ErrorModel:
        """The model of a JSON file."""
        with open(path, encoding="utf-8") as file:
            return cls(json.load(file))

    def start(self, rng: Any, unit: bool = True) -> State:
        """The state of a new unit in a random field; unit : whether its bias is drawn, or the mean of all units."""
        bias = self.mean + (self.unit * rng.standard_normal(3) if unit else 0.0)
        return State(rng.standard_normal(3), rng.standard_normal(3), float(rng.standard_normal()), bias)

    def noise_arcsec(self, rate_deg_s: Any) -> Any:
        """(N, 3) standard deviation of the temporal noise at (N,) rates."""
        return np.stack([np.interp(rate_deg_s, self.rates_deg_s, column) for column in self.noise.T], axis=-1)

    def draw(self, rate_deg_s: Any, step_s: float, rng: Any, state: State | None = None) -> Any:
        """(N, 3) errors in arcseconds, at times step_s apart.

        rate_deg_s : (N,) rate of the boresight; from one time to the next it turns by rate times step
        state      : at the first time; that of a new unit in a random field if left out
        """
        rate = np.abs(np.asarray(rate_deg_s, dtype=float))
        first = self.start(rng) if state is None else state
        turned = rate * step_s
        field, pixel, scale = (
            correlated(turned / self.constants[f"{name}_deg"], getattr(first, name), rng)
            for name in ("field", "pixel", "scale")
        )
        slow = self.field * field + self.pixel * pixel
        noise = self.noise_arcsec(rate) * rng.standard_normal((len(rate), 3))
        return first.bias + self.scales(scale) * (slow + noise)

    def step(self, state: State, rate_deg_s: float, step_s: float, rng: Any) -> tuple[State, Any]:
        """The state one step later, and its (3,) errors in arcseconds."""
        turned = abs(rate_deg_s) * step_s
        new = []
        for name in ("field", "pixel", "scale"):
            left = math.exp(-turned / self.constants[f"{name}_deg"])
            old = getattr(state, name)
            new.append(left * old + math.sqrt(1 - left * left) * rng.standard_normal(np.shape(old)))
        later = State(new[0], new[1], float(new[2]), state.bias)
        noise = self.noise_arcsec(np.array([abs(rate_deg_s)]))[0] * rng.standard_normal(3)
        slow = self.field * later.field + self.pixel * later.pixel
        return later, later.bias + self.scales(np.array([later.scale]))[0] * (slow + noise)

    def correlation(self, angle_deg: float, rate_deg_s: float) -> Any:
        """(3,) correlation of two errors of one unit at a rate, between which the boresight turns by an angle.

        E[s_k s_l] = exp(-v^2 (1 - r) / 4) for lognormal scales whose normal numbers have the correlation r.
        """
        field, pixel, scale = (
            math.exp(-abs(angle_deg) / self.constants[f"{name}_deg"]) for name in ("field", "pixel", "scale")
        )
        noise = self.noise_arcsec(np.array([abs(rate_deg_s)]))[0]
        shared = self.field**2 * field + self.pixel**2 * pixel
        total = self.field**2 + self.pixel**2 + noise**2
        return np.exp(-(self.scale**2) * (1 - scale) / 4) * shared / total

    def scales(self, normal: Any) -> Any:
        """(N, 3) scales of standard normal numbers: s^2 = exp(v q - v^2 / 2) has the mean 1."""
        return np.exp(0.5 * (np.multiply.outer(normal, self.scale) - self.scale**2 / 2))


def correlated(steps: Any, first: Any, rng: Any) -> Any:
    """(N, ...) Gauss-Markov process x_k = c_k x_(k-1) + sqrt(1 - c_k^2) n_k from x_0 = first, c_k = exp(-steps_k).

    The recursion is composed in log2 N passes over the array (Hillis & Steele 1986), without a loop over the times.
    """
    shape = (len(steps), *np.shape(first))
    left = np.exp(-np.asarray(steps)).reshape(-1, *[1] * np.ndim(first))
    values = np.sqrt(1 - left**2) * rng.standard_normal(shape)
    values[0], left[0] = first, 0.0
    shift = 1
    while shift < len(values) and left.any():
        values[shift:] += left[shift:] * values[:-shift]
        left[shift:] *= left[:-shift].copy()
        shift *= 2
    return values
