"""Export a study's results for other tools: CSV, Parquet and Zarr, and as an xarray dataset."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError, unknown_name
from skysim.core.io import files
from skysim.experiments.study.analysis.table import table, to_columns, trial_columns
from skysim.experiments.study.store import Store
from skysim.results.files.export import EXTRA


def to_csv(store: Store, responses: tuple[str, ...], path: Path) -> None:
    """Write one line per trial, missing values empty; numbers in Python's shortest form, which reads back exactly.

    Columns without any value are left out: of a study of frames, for example, those of flights.
    """
    every = trial_columns(store)
    columns = {name: column for name, column in every.items() if any(map(has_value, column.tolist()))} or every
    with files.atomic_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*(column.tolist() for column in columns.values()), strict=True):
            writer.writerow([value if has_value(value) else "" for value in row])


def has_value(value: Any) -> bool:
    """Whether a value is neither None nor NaN."""
    return value is not None and value == value


def to_parquet(store: Store, responses: tuple[str, ...], path: Path) -> None:
    """Write one row per trial; title, code version and study file are in the file's metadata.

    Raises InputError if pyarrow is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError(f"{path}: Parquet {EXTRA}") from None
    columns = {name: pyarrow.array(column.tolist()) for name, column in trial_columns(store).items()}
    meta = {key: store.meta(key) for key in ("title", "code", "study")}
    with files.atomic_file(path) as temporary:
        pyarrow.parquet.write_table(pyarrow.table(columns).replace_schema_metadata(meta), temporary)


def dataset(store: Store, responses: tuple[str, ...], path: Path) -> Any:
    """An xarray.Dataset of every response with its interval and count.

    The dimensions are the factors if the design is a full factorial, otherwise the points. Raises InputError if
    xarray or pandas is not installed.
    """
    try:
        import pandas
        import xarray
    except ImportError:
        raise InputError(f"{path}: xarray {EXTRA}") from None
    lines = table(store, responses)
    frame = pandas.DataFrame(to_columns(lines))
    factors = list(lines[0].levels) if lines else []
    for name in factors:
        if frame[name].map(type).isin([list, dict]).any():
            frame[name] = frame[name].map(str)
    sizes = [frame[name].nunique() for name in factors]
    full = factors and int(np.prod(sizes)) == len(frame) and not frame.duplicated(factors).any()
    meta = {key: store.meta(key) for key in ("title", "code", "study")}
    indexed = frame.set_index(factors if full else ["point"])
    return xarray.Dataset.from_dataframe(indexed).assign_attrs(meta)


def to_zarr(store: Store, responses: tuple[str, ...], path: Path) -> None:
    """Write `dataset` as a Zarr folder."""
    tables = dataset(store, responses, path)
    with files.atomic_folder(path) as temporary:
        tables.to_zarr(temporary, mode="w", consolidated=False)


EXPORTS: dict[str, Callable[[Store, tuple[str, ...], Path], None]] = {
    ".csv": to_csv,
    ".parquet": to_parquet,
    ".zarr": to_zarr,
}


def export(store: Store, responses: tuple[str, ...], path: Path) -> None:
    """Write a study's results in the format given by the path's suffix. Raises InputError for an unknown suffix."""
    if path.suffix not in EXPORTS:
        raise InputError(f"{path}: {unknown_name('file format', path.suffix, EXPORTS)}")
    files.make_folder(path.parent)
    EXPORTS[path.suffix](store, responses, path)
