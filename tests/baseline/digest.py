"""Digests of arrays, tables, files and JSON, and the structure of JSON."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

Entries = Iterator[tuple[str, str]]
DIGITS = 24  # of a SHA-256, in hexadecimal
# Keys and columns that change from run to run, or with every change of the code: times by the clock, digests of code.
CHANGING = re.compile(
    r"(\w*_)?((time|detect|late)_ms\w*|stages_ms|seconds|unix_s|code|scene)"
)


def sha(data: bytes | str) -> str:
    """The beginning of the SHA-256 of bytes, or of a text in UTF-8."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[
        :DIGITS
    ]


def array(values: np.ndarray) -> str:
    """Type, shape and digest of an array, whatever its byte order."""
    plain = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return f"{plain.dtype.str} {plain.shape} {sha(plain.tobytes())}"


def frame_file(path: Path) -> Entries:
    """Pixels and header cards of a FITS file."""
    with fits.open(path) as parts:
        yield "pixels", array(parts[0].data)
        yield "header", sha("\n".join(str(card) for card in parts[0].header.cards))


def ecsv(path: Path) -> Entries:
    """Each column of an ECSV table as it is written; and the header with units and metadata."""
    lines = path.read_text(encoding="utf-8").splitlines()
    names, *rows = csv.reader(
        [line for line in lines if not line.startswith("#")], delimiter=" "
    )
    yield "header", sha("\n".join(line for line in lines if line.startswith("#")))
    for number, name in enumerate(names):
        if not CHANGING.fullmatch(name):
            yield name, f"{len(rows)} rows {sha(json.dumps([row[number] for row in rows]))}"


def steady(value: Any) -> Any:
    """JSON without values that change from run to run."""
    if isinstance(value, dict):
        return {
            key: steady(inner) for key, inner in value.items() if not CHANGING.fullmatch(key)
        }
    if isinstance(value, list):  # without sentences about times
        return [
            steady(inner)
            for inner in value
            if not (isinstance(inner, str) and "time_ms" in inner)
        ]
    return value


def values(document: dict[str, Any]) -> Entries:
    """Each key of a JSON object: a short value as it is, else a digest."""
    for key, value in steady(document).items():
        text = json.dumps(value, ensure_ascii=False)
        yield key, text if len(text) < 80 else f"{len(value)} items {sha(text)}"


def structure(value: Any) -> dict[str, str]:
    """Types in a JSON value by path, such as `rows[].frame`: int; all elements of a list have one path."""
    found: dict[str, set[str]] = {}
    collect(value, "", found)
    return {path: " or ".join(sorted(kinds)) for path, kinds in found.items()}


def collect(value: Any, path: str, found: dict[str, set[str]]) -> None:
    """Add the types in a JSON value to those found so far."""
    found.setdefault(path, set()).add("null" if value is None else type(value).__name__)
    if isinstance(value, dict):
        for key, inner in value.items():
            collect(inner, f"{path}.{key}".lstrip("."), found)
    if isinstance(value, list):
        for inner in value:
            collect(inner, f"{path}[]", found)
