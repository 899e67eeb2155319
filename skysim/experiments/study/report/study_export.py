"""Export a study's results for other tools: CSV, Parquet and Zarr, and as an xarray dataset."""

import csv
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core import files
from skysim.core.errors import check_name, refusing
from skysim.core.types import Array
from skysim.experiments.study.execution.store import COLUMNS, Store
from skysim.experiments.study.table import level_columns, table, to_columns, with_levels
from skysim.results.files.row_parts import EXTRA, encoding, to_arrow

Names = tuple[str, ...]
META = ("title", "code", "study")  # what the files say of the study


def to_csv(store: Store, responses: Names, path: Path) -> None:
    """Write one line per trial, with missing values empty and numbers in Python's shortest exact form.

    Columns without any value are left out, for example those of flights in a study of frames.
    """
    levels = level_columns(store)
    empty = set(COLUMNS)
    for block in store.blocks():
        empty -= {name for name in empty if has_values(block[name])}
    # Without trials all columns are kept.
    names = [name for name in (*COLUMNS, *levels) if name not in empty or "trial" in empty]
    with (
        files.atomic_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(names)
        for block in store.blocks():
            columns = with_levels(block, levels)
            writer.writerows(zip(*(texts(columns[name]) for name in names), strict=True))


def has_values(column: Array) -> bool:
    """Whether any value is neither None nor NaN."""
    return (
        any(value is not None for value in column)
        if column.dtype == object
        else bool(np.any(column == column))
    )


def texts(column: Array) -> list[Any]:
    """Values for CSV: an empty string for None and NaN."""
    values = column.tolist()
    return [value if value is not None and value == value else "" for value in values]


def to_parquet(store: Store, responses: Names, path: Path) -> None:
    """Write one row per trial, missing values null; title, code version and study file are in the file's metadata.

    Raises
    ------
    InputError
        If pyarrow is not installed.
    """
    with refusing(ImportError, path, f"Parquet {EXTRA}"):
        import pyarrow.parquet
    levels = level_columns(store)
    meta = {key: store.meta(key) for key in META}
    tables = (
        to_arrow(with_levels(block, levels)).replace_schema_metadata(meta)
        for block in store.blocks()
    )
    first = next(tables)
    with (
        files.atomic_file(path) as temporary,
        pyarrow.parquet.ParquetWriter(
            temporary, first.schema, **encoding(first.schema)
        ) as writer,
    ):
        for rows in itertools.chain([first], tables):
            writer.write_table(rows)


def to_zarr(store: Store, responses: Names, path: Path) -> None:
    """Write an xarray.Dataset of every response with its interval and count as a Zarr folder.

    The dimensions are the factors if the design is a full factorial, otherwise the points. Raises InputError if
    xarray or pandas is not installed.
    """
    with refusing(ImportError, path, f"xarray {EXTRA}"):
        import pandas
        import xarray
    lines = table(store, responses)
    frame = pandas.DataFrame(to_columns(lines))
    factors = list(lines[0].levels) if lines else []
    for name in factors:
        if frame[name].map(type).isin([list, dict]).any():
            frame[name] = frame[name].map(str)
    sizes = [frame[name].nunique() for name in factors]
    full = (
        factors and int(np.prod(sizes)) == len(frame) and not frame.duplicated(factors).any()
    )
    meta = {key: store.meta(key) for key in META}
    indexed = frame.set_index(factors if full else ["point"])
    tables = xarray.Dataset.from_dataframe(indexed).assign_attrs(meta)
    with files.atomic_folder(path) as temporary:
        tables.to_zarr(temporary, mode="w", consolidated=False)


EXPORTS: dict[str, Callable[[Store, Names, Path], None]] = {
    ".csv": to_csv,
    ".parquet": to_parquet,
    ".zarr": to_zarr,
}


def export(store: Store, responses: Names, path: Path) -> None:
    """Write a study's results in the format given by the path's suffix. Raises InputError for an unknown suffix."""
    check_name(path, "file format", path.suffix, EXPORTS)
    files.make_folder(path.parent)
    EXPORTS[path.suffix](store, responses, path)
