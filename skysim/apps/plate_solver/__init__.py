"""Plate solver of `skysim solve`, `skysim.solve` and the browser's photo panel.

A file is loaded as a picture in the orientation of viewing (`picture.py`) and solved without a prior attitude
(`solver.py`). After a refusal other centroids are tried, and the likely cause is found (`diagnosis.py`).
Pictures of a dome's LEDs are solved by the tracker of a scene (`plate_solution.py`).
"""

from skysim.apps.plate_solver.picture import (
    Outputs,
    annotated_paths,
    load_picture,
    outcome_fields,
    pictures_in,
    solve,
    solve_file,
    solve_picture,
)
from skysim.apps.plate_solver.plate_solution import (
    DomeSolution,
    DomeSolver,
    PlateSolution,
    add_rates,
    make_dome_solver,
    sequence_summary,
    solution_fields,
    wcs_header,
)
from skysim.apps.plate_solver.solver import (
    Solver,
    best_attitude,
    kept_solver,
    make_solver,
    read_camera,
    solve_array,
    validated_date,
)

__all__ = [
    "DomeSolution",
    "DomeSolver",
    "Outputs",
    "PlateSolution",
    "Solver",
    "add_rates",
    "annotated_paths",
    "best_attitude",
    "kept_solver",
    "load_picture",
    "make_dome_solver",
    "make_solver",
    "outcome_fields",
    "pictures_in",
    "read_camera",
    "sequence_summary",
    "solution_fields",
    "solve",
    "solve_array",
    "solve_file",
    "solve_picture",
    "validated_date",
    "wcs_header",
]
