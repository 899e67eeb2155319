"""Write a measurement model: a Python module that needs NumPy alone, its constants as JSON, a co-simulation unit."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any
from skysim.core.errors import InputError
from skysim.core.files import (make_folder, to_json, write_text)



MODULE = "tracker_error.py"
CONSTANTS = "tracker_error.json"
HERE = Path(__file__).parent


def write_model(folder: Path, constants: dict[str, Any]) -> list[Path]:
    """Write the module and its constants to a folder; return their paths."""
    paths = [make_folder(folder) / MODULE, folder / CONSTANTS]
    write_text(paths[0], (HERE / "errors.py").read_text(encoding="utf-8"))
    write_text(paths[1], to_json(constants))
    return paths


def require_fmu_builder() -> None:
    """Raise InputError if the package that builds the units is not installed."""
    if find_spec("pythonfmu3") is None:
        raise InputError(
            "datasheet.fmu", "pythonfmu3 is not installed", "after pip install 'skysim[fmu]'"
        )


def write_fmu(folder: Path) -> Path:
    """Build the co-simulation unit (FMI 3) from a folder of `write_model`; return its path.

    It runs in a Python with NumPy on the machine of the importer.
    """
    require_fmu_builder()
    from pythonfmu3.builder import FmuBuilder

    script = folder / "fmu_slave.py"
    write_text(script, (HERE / "fmu_slave.py").read_text(encoding="utf-8"))
    return Path(
        FmuBuilder.build_FMU(
            script, dest=folder, project_files=[folder / MODULE, folder / CONSTANTS]
        )
    )


