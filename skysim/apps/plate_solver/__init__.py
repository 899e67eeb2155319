"""Plate solver of `skysim solve`, `skysim.solve` and the browser's photo panel.

From a file to the picture as it is viewed (`picture.py`), to a solution without a prior attitude (`solver.py`,
`solution.py`), or to the likely cause of a refusal (`diagnosis.py`).
"""

from skysim.apps.plate_solver.picture import annotated_paths as annotated_paths
from skysim.apps.plate_solver.picture import load_picture as load_picture
from skysim.apps.plate_solver.picture import outcome_fields as outcome_fields
from skysim.apps.plate_solver.picture import pictures_in as pictures_in
from skysim.apps.plate_solver.picture import solve as solve
from skysim.apps.plate_solver.picture import solve_file as solve_file
from skysim.apps.plate_solver.picture import solve_picture as solve_picture
from skysim.apps.plate_solver.solver import FIELD_SEARCH as FIELD_SEARCH
from skysim.apps.plate_solver.solver import PlateSolution as PlateSolution
from skysim.apps.plate_solver.solver import Solver as Solver
from skysim.apps.plate_solver.solver import best_attitude as best_attitude
from skysim.apps.plate_solver.solver import kept_solver as kept_solver
from skysim.apps.plate_solver.solver import make_solver as make_solver
from skysim.apps.plate_solver.solver import solution_fields as solution_fields
from skysim.apps.plate_solver.solver import solve_array as solve_array
from skysim.apps.plate_solver.solver import validated_date as validated_date
