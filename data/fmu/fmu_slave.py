"""The co-simulation unit of an error model. It runs inside an FMU, beside tracker_error.py and tracker_error.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability, Int32
from tracker_error import ErrorModel  # type: ignore[import-not-found]


class TrackerError(Fmi3Slave):
    """Unit with the boresight's rate as input, and the errors about the camera's axes, drawn at every step, as outputs.

    Attributes
    ----------
    seed
        Seed of the random numbers; read at the first step
    """

    author = "skysim"
    description = "Attitude errors of a star tracker, arcseconds about the camera's axes"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.time = 0.0
        self.seed = 1
        self.rate_deg_s = 0.0
        self.x_arcsec = self.y_arcsec = self.roll_arcsec = 0.0
        self.model = ErrorModel.read(Path(self.resources) / "tracker_error.json")
        self.state: Any = None
        independent = {
            "causality": Fmi3Causality.independent,
            "variability": Fmi3Variability.continuous,
        }
        self.register_variable(Float64("time", **independent))
        self.register_variable(
            Int32(
                "seed", causality=Fmi3Causality.parameter, variability=Fmi3Variability.fixed
            )
        )
        self.register_variable(Float64("rate_deg_s", causality=Fmi3Causality.input))
        for name in ("x_arcsec", "y_arcsec", "roll_arcsec"):
            self.register_variable(Float64(name, causality=Fmi3Causality.output))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Draw the errors at the end of the step."""
        if self.state is None:
            self.rng = np.random.default_rng(self.seed)  # noqa: TID251  (no part of skysim runs)
            self.state = self.model.start(self.rng)
        self.state, errors = self.model.step(self.state, self.rate_deg_s, step_size, self.rng)
        self.x_arcsec, self.y_arcsec, self.roll_arcsec = errors.tolist()
        self.time = current_time + step_size
        return True
