"""Columns of trials that may be too many for memory: each is read when it is used, also from Parquet files.

A part is a Parquet file of some hundred thousand trials, written once and never changed. Missing values are null there,
NaN or None in arrays. Trials are in the order of point and replicate, from which their numbers follow.
"""

import importlib.util
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError
from skysim.core.files import atomic_file
from skysim.core.types import Array, Record

EXTRA = "needs optional packages: pip install 'skysim[export]'"
KEPT_BYTES = 250_000_000  # size of the columns kept in memory for further use; the oldest are dropped first

Columns = Mapping[str, Array]
Source = Callable[[str], Array]  # the column of some rows by its name


class Rows(Mapping[str, Array]):
    """Columns of some rows by name; a column is read when it is first used.

    Attributes
    ----------
    names
        Names of the columns, in order
    sources
        Functions that return a column of a part of the rows; the parts follow one another
    counts
        Number of rows of each source
    order
        (N,) index of each row in the joined rows of the sources; None to keep the order of the sources
    """

    def __init__(
        self,
        names: Sequence[str],
        sources: Sequence[Source],
        counts: Sequence[int],
        order: Array | None = None,
    ) -> None:
        self.names = tuple(names)
        self.sources = tuple(sources)
        self.order = order
        self.starts = np.cumsum([0, *counts])
        self._kept: dict[str, Array] = {}

    def __getitem__(self, name: str) -> Array:
        if name not in self.names:
            raise KeyError(name)
        if name not in self._kept:
            columns = [source(name) for source in self.sources]
            column = columns[0] if len(columns) == 1 else np.concatenate(columns)
            del columns
            column = column if self.order is None else column[self.order]
            left = KEPT_BYTES - column.nbytes
            while self._kept and sum(one.nbytes for one in self._kept.values()) > left:
                del self._kept[next(iter(self._kept))]
            self._kept[name] = column
        return self._kept[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def row(self, number: int) -> dict[str, Array]:
        """The columns of one row, read from its source alone."""
        place = number if self.order is None else int(self.order[number])
        source = int(np.searchsorted(self.starts, place, side="right")) - 1
        here = place - int(self.starts[source])
        return {name: self.sources[source](name)[here : here + 1] for name in self.names}


def row_of(columns: Columns, number: int) -> Columns:
    """The columns of one row."""
    one = slice(number, number + 1)
    return (
        columns.row(number)
        if isinstance(columns, Rows)
        else {name: columns[name][one] for name in columns}
    )


def subset(columns: Columns, rows: Array | slice) -> Rows:
    """Some rows of a table, by their numbers or from one to another."""
    count = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
    return Rows(tuple(columns), [lambda name: columns[name][rows]], [count])


# Parquet.


def can_write_parts() -> bool:
    """Whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def to_arrow(columns: Columns) -> Any:
    """An Arrow table; missing values (NaN, None) are null."""
    import pyarrow

    return pyarrow.table(
        {
            name: pyarrow.array(
                column, pyarrow.string() if column.dtype == object else None, from_pandas=True
            )
            for name, column in columns.items()
        }
    )


def write_part(path: Path, columns: Columns) -> None:
    """Write a part. It appears whole and on the disk, or not at all."""
    import pyarrow.parquet

    table = to_arrow(columns)
    with atomic_file(path) as temporary:
        pyarrow.parquet.write_table(
            table, temporary, row_group_size=table.num_rows, **encoding(table.schema)
        )
        sync(temporary)
    sync(path.parent)


def encoding(schema: Any) -> Record:
    """Options of the Parquet writer: split bytes for floats, dictionaries for all other columns.

    A float's exponent compresses well, its fraction hardly. Grouping all first bytes, all second bytes and so on takes
    less space and time than a dictionary of numbers that are all different.
    """
    floats = [field.name for field in schema if str(field.type) == "double"]
    others = [field.name for field in schema if field.name not in floats]
    return {"compression": "zstd", "use_dictionary": others, "use_byte_stream_split": floats}


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk; other systems than POSIX sync no folders."""
    if path.is_dir() and os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@dataclass(eq=False)
class Part:
    """A part: its file, its numbers of rows and of wrong attitudes, and the points of its first and its last row."""

    path: Path
    rows: int
    wrong: int
    first: int
    last: int
    _trials: tuple[int, Array] = (0, np.empty(0, np.int64))

    def trials(self, replicates: int) -> Array:
        """(N,) numbers of its trials, where a point has so many. Raises InputError for a part that is not as listed."""
        if self._trials[0] != replicates:
            point, replicate = (
                read_column(self.path, name) for name in ("point", "replicate")
            )
            if not len(point) == len(replicate) == self.rows > 0:
                raise InputError(
                    self.path,
                    f"has {len(point)} rows",
                    f"{self.rows}, as the study store lists",
                )
            if not (are_below(point, self.last + 1) and are_below(replicate, replicates)):
                raise InputError(
                    self.path,
                    "not a valid part of a study store: points and replicates",
                    f"0 to {self.last}, 0 to {replicates - 1}",
                )
            self._trials = replicates, point * replicates + replicate
        return self._trials[1]

    def source(self, ranges: Sequence[tuple[int, int]], replicates: int) -> Source | None:
        """The columns of the trials in some ranges of numbers; None if there are none."""
        near = np.array(ranges)
        near = near[
            (near[:, 0] < (self.last + 1) * replicates)
            & (near[:, 1] > self.first * replicates)
        ]
        if not len(near):
            return None
        trials = self.trials(replicates)
        rows = [
            slice(first, end)
            for first, end in np.searchsorted(trials, near).tolist()
            if end > first
        ]

        def column(name: str) -> Array:
            whole = trials if name == "trial" else read_column(self.path, name)
            return (
                whole[rows[0]]
                if len(rows) == 1
                else np.concatenate([whole[one] for one in rows])
            )

        return column if rows else None


def are_below(numbers: Array, end: int) -> bool:
    """Whether these are integers from 0 on and below the end."""
    return bool(numbers.dtype.kind == "i" and numbers.min() >= 0 and numbers.max() < end)


def read_column(path: Path, name: str) -> Array:
    """A column of a part: numbers, or objects for text. Raises InputError if it cannot be read."""
    try:
        import pyarrow.parquet

        # Texts are read as numbers of distinct texts, since there are few of them.
        column = pyarrow.parquet.ParquetFile(path).read([name]).column(name)
        if not pyarrow.types.is_string(column.type):
            return column.to_numpy()
        coded = column.combine_chunks().dictionary_encode()
        texts = np.array([*coded.dictionary.to_pylist(), None], dtype=object)
        return texts[coded.indices.fill_null(len(texts) - 1).to_numpy()]
    except ImportError:
        raise InputError(path, f"Parquet {EXTRA}") from None
    except (
        OSError,
        ValueError,
        KeyError,
        NotImplementedError,
        MemoryError,
    ) as error:  # pyarrow's are among them
        raise InputError(
            path, f"not a valid part of a study store: {' '.join(str(error).split())[:120]}"
        ) from None
