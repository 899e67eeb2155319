"""Errors in words of the page, which has fields instead of parameters and options."""

from __future__ import annotations

from skysim.core.errors import OVERRIDES, InputError

LABELS = {  # of the fields, by the parameter's key; a key of a scene is the label of its field
    "solve.fov_deg": "the field of view",
    "solve.time_utc": "the date",
    "solve.catalog": "the star catalog",
    "solve.detector": "the detector",
    "solve.centroider": "the centroider",
    "solve.identifier": "the identifier",
    "solve.solver": "the solver",
    "survey.tilt_deg": "the tilt",
}


def for_page(error: InputError) -> str:
    """An error with the label of the field at fault; without a place if the value was typed in the page."""
    where = None if error.where == OVERRIDES else error.where
    return str(InputError(LABELS.get(error.key, error.key), error.problem, error.allowed, where))
