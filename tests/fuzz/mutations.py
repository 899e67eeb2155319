"""Mutations that know the structure of a file: YAML, tables, XML, JSON, FITS, arrays, SQLite; and of any file.

Each takes a seed's bytes and a random stream and returns a `Mutant`, which says what was done and what a reader must
then do: refuse the file, or name a line. Mutations of files of a binary kind are in `mutate` of `tests.fuzz.__main__`.
"""

from __future__ import annotations

import io
import json
import math
import re
import sqlite3
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
import yaml
from astropy.io import fits

from tests.fuzz.__main__ import mutate

LONG = 100_000  # entries of a long list


class Mutant(NamedTuple):
    """A mutated file.

    Attributes
    ----------
    data
        Its bytes; None for a file that is another thing than a regular file
    what
        What was done
    is_wrong
        Whether no reader may take it
    line
        Line that is at fault, which the refusal should name; 0 if unknown
    """

    data: bytes | None
    what: str
    is_wrong: bool = False
    line: int = 0


Mutation = Callable[[bytes, Random], Mutant]
# Values of another type or size, as YAML; those of NEVER are refused wherever a number stands.
NEVER = (
    "1e300",
    "-1e300",
    ".inf",
    "-.inf",
    ".nan",
    "nan",
    "'1e300 m'",
    "'-1e300 s'",
    "'nan m'",
    "9" * 40,
    "-" + "9" * 400,
    "some text",
    "{a: 1}",
    "[[1]]",
)
ODD = (
    *NEVER,
    "null",
    "true",
    "-1",
    "0",
    "-0.0",
    "1e-320",
    "0x1F",
    "012",
    "1_000",
    "12:30:00",
    "2012-01-01",
    "0001-01-01T00:00:00",
    "9999-12-31T23:59:59",
    "''",
    "' '",
    "[]",
    "{}",
    "[1, 2]",
    "[1, two, {three: 3}]",
    "'-5 mm'",
    "'5 kg'",
    "'1e-300 s'",
    "'0.001 um'",
    "'1e4 m'",
    "'3e9 s'",
    "'5 m(1/0)'",
    "1000000",
    "65536",
    "☃",
    "'\u202egnp.exe'",
    "'\\x1b[31m'",
    "'" + "x" * 5000 + "'",
    "../../../etc/passwd",
    "/dev/zero",
    "/dev/null",
    ".",
    "none",
    "!!binary aGVsbG8=",
    "!!set {a, b}",
    "!!python/name:os.system",
    "&a [*a]",
)
CELLS = (
    "",
    "nan",
    "inf",
    "-inf",
    "1e300",
    "-1e300",
    "1e999",
    "-1",
    "0",
    "1e-320",
    "text",
    "1,5",
    "１２",
    "0x10",
    "1_0",
    "9" * 400,
    "☃",
    '"',
    "x" * 5000,
    "1e308",
    "\0",
    "true",
)
NO_NUMBERS = ("nan", "inf", "-inf", "1e999", "text", "☃", "x" * 5000, "0x10", "9" * 400)


# Any file


def emptied(data: bytes, rng: Random) -> Mutant:
    """Nothing, blanks, or other bytes."""
    what = rng.choice(("empty", "blank", "junk", "zeros"))
    new = {
        "empty": b"",
        "blank": b" \n" * 9,
        "junk": rng.randbytes(400),
        "zeros": bytes(4000),
    }[what]
    return Mutant(new, what, is_wrong=True)


def no_file(data: bytes, rng: Random) -> Mutant:
    """A folder, a named pipe, a link to itself, an endless device: `campaign.place` makes it."""
    what = rng.choice(("folder", "pipe", "loop", "dangling", "zero", "memory"))
    return Mutant(None, what, is_wrong=True)


def cut(data: bytes, rng: Random) -> Mutant:
    """A file that ends early."""
    return Mutant(data[: rng.randrange(len(data) + 1)], "cut")


def flipped(data: bytes, rng: Random) -> Mutant:
    """A few bytes changed at random."""
    return Mutant(mutate(data or b" ", [data or b" "], rng), "bytes")


def recoded(data: bytes, rng: Random) -> Mutant:
    """Another encoding, or other ends of lines."""
    what = rng.choice(("utf-16", "latin-1", "bom", "crlf", "cr", "nul", "utf-7"))
    text = data.decode("utf-8", "replace")
    new = {
        "utf-16": lambda: text.encode("utf-16"),
        "utf-7": lambda: text.encode("utf-7"),
        "latin-1": lambda: "# Prüfstand µ\n".encode("latin-1") + data,
        "bom": lambda: b"\xef\xbb\xbf" + data,
        "crlf": lambda: data.replace(b"\n", b"\r\n"),
        "cr": lambda: data.replace(b"\n", b"\r"),
        "nul": lambda: data.replace(b"\n", b"\0\n", 1),
    }[what]()
    return Mutant(new, what)


def relined(data: bytes, rng: Random) -> Mutant:
    """Lines left out, repeated, moved, or very many."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    what = rng.choice(("left out", "repeated", "moved", "very many", "long"))
    if what == "left out":
        del lines[at : at + rng.choice((1, 1, 3))]
    elif what == "repeated":
        lines[at:at] = [lines[at]]
    elif what == "moved":
        lines.insert(rng.randrange(len(lines)), lines.pop(at))
    elif what == "very many":
        lines[at:at] = [lines[at]] * min(LONG, 20_000_000 // (len(lines[at]) + 1))
    else:
        lines[at] *= 1 + 1_000_000 // (len(lines[at]) + 1)
    return Mutant(b"\n".join(lines), f"line {what}")


ANY: tuple[Mutation, ...] = (emptied, no_file, cut, flipped, recoded, relined)


# YAML


class Place(NamedTuple):
    """A value in a YAML text: its node, keys, and the node of its key if it has one."""

    node: yaml.Node
    keys: tuple[str, ...]
    key: yaml.Node | None


def places(node: yaml.Node | None, keys: tuple[str, ...] = ()) -> list[Place]:
    """Every value of a YAML text."""
    found = []
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            found += [Place(value, (*keys, str(key.value)), key)]
            found += places(value, (*keys, str(key.value)))
    elif isinstance(node, yaml.SequenceNode):
        for n, value in enumerate(node.value):
            found += [Place(value, (*keys, str(n)), None), *places(value, (*keys, str(n)))]
    return found


def is_number(node: yaml.Node) -> bool:
    """Whether a value is a number, or one with a unit."""
    return isinstance(node, yaml.ScalarNode) and bool(
        node.tag.endswith((":int", ":float")) or re.match(r"[-+]?[\d.]+ ?[a-z]", node.value)
    )


def yaml_value(data: bytes, rng: Random) -> Mutant:
    """A value of another type or size in the place of one, of a section or of a list."""
    text = data.decode()
    place = rng.choice(places(yaml.compose(text)) or [Place(yaml.compose(text), (), None)])
    odd = rng.choice(ODD)
    if rng.random() < 0.1:
        odd = "[" + ", ".join(["0"] * LONG) + "]"
    elif rng.random() < 0.05:
        odd = "[" * 300 + "]" * 300
    return put(text, place, odd)


def put(text: str, place: Place, new: str) -> Mutant:
    """A YAML text with a new value at a place."""
    begin, end = place.node.start_mark, place.node.end_mark
    block = isinstance(place.node, yaml.CollectionNode) and not place.node.flow_style
    # A block ends where the next key begins.
    after = "\n" + " " * end.column if block and end.index < len(text) else ""
    wrong = new in NEVER and is_number(place.node) and "options" not in place.keys
    what = f"{'.'.join(place.keys)} = {new[:40]}"
    return Mutant(
        (text[: begin.index] + new + after + text[end.index :]).encode(),
        what,
        wrong,
        begin.line + 1,
    )


def yaml_number(data: bytes, rng: Random) -> Mutant:
    """A number scaled by a power of ten or with the other sign, with its unit."""
    text = data.decode()
    found = [place for place in places(yaml.compose(text)) if is_number(place.node)]
    if not found:
        return yaml_value(data, rng)
    place = rng.choice(found)
    number, unit = re.match(
        r"([-+]?[\d._]+(?:[eE][-+]?\d+)?)(.*)", place.node.value, re.S
    ).groups()
    scaled = float(number) * rng.choice((-1, 0, 1e-9, 1e-3, 1e-1, 10, 1e3, 1e6, 1e12, 1e300))
    shown = (
        f"{round(scaled)}"
        if ":int" in place.node.tag and abs(scaled) < 1e20
        else f"{scaled!r}"
    )
    return put(text, place, f'"{shown}{unit}"' if unit else shown)._replace(is_wrong=False)


def yaml_key(data: bytes, rng: Random) -> Mutant:
    """A key misspelled, repeated, left out, or added."""
    text = data.decode()
    found = [place for place in places(yaml.compose(text)) if place.key is not None]
    if not found:
        return yaml_value(data, rng)
    place = rng.choice(found)
    begin, end = place.key.start_mark, place.key.end_mark
    what = rng.choice(("misspelled", "repeated", "left out", "added"))
    word = rng.choice(
        ("colour", "__class__", "x" * 5000, "☃", "1", "", "null", "[1, 2]", "kind")
    )
    after = place.node.end_mark
    flow = (
        ", "
        if "{" in text[max(begin.index - 1, 0) : begin.index] + text[end.index : after.index]
        else ""
    )
    if what == "misspelled":
        new = text[: end.index] + rng.choice("xs") + text[end.index :]
    elif what == "left out":
        new = text[: begin.index] + text[after.index :]
    else:
        own = f"{text[begin.index : end.index]}: 1" if what == "repeated" else f"{word}: 1"
        new = (
            text[: begin.index]
            + own
            + (flow or "\n" + " " * begin.column)
            + text[begin.index :]
        )
    free = {"options", "set", "factors", "levels", "types", "require", "heads"} & {
        *place.keys
    }
    return Mutant(
        new.encode(),
        f"key {'.'.join(place.keys)} {what}",
        what == "repeated" and not flow,
        0 if free else begin.line + 1,
    )


def yaml_swap(data: bytes, rng: Random) -> Mutant:
    """A value in the place of another one of the same text."""
    text = data.decode()
    found = places(yaml.compose(text))
    if len(found) < 2:
        return yaml_value(data, rng)
    one, other = rng.sample(found, 2)
    new = text[other.node.start_mark.index : other.node.end_mark.index]
    flow = isinstance(other.node, yaml.ScalarNode) or other.node.flow_style
    return put(text, one, new if flow else "{}")._replace(is_wrong=False)


def guarded(mutation: Mutation, otherwise: Mutation) -> Mutation:
    """A mutation, or another one if the seed has not its structure."""

    def apply(data: bytes, rng: Random) -> Mutant:
        try:
            return mutation(data, rng)
        except (yaml.YAMLError, ValueError, IndexError, AttributeError, TypeError, KeyError):
            return otherwise(data, rng)

    apply.__name__ = mutation.__name__
    return apply


YAML = (
    *(
        guarded(one, flipped)
        for one in (yaml_value, yaml_value, yaml_number, yaml_number, yaml_key, yaml_swap)
    ),
    *(guarded(one, flipped) for one in (yaml_value, yaml_number)),
)


# Tables


def rows_of(data: bytes) -> tuple[list[str], list[int]]:
    """The lines of a table, and the numbers of those that are no comments; the first has the names."""
    lines = data.decode().split("\n")
    return lines, [n for n, line in enumerate(lines) if line.strip() and line[0] not in "#%"]


def separator(line: str) -> str:
    """What separates the cells of a line."""
    return next((one for one in (",", ";", "\t") if one in line), " ")


def table_cell(data: bytes, rng: Random) -> Mutant:
    """Another value in a cell of a row."""
    lines, rows = rows_of(data)
    n = rng.choice(rows[1:] or rows)
    mark = separator(lines[n])
    cells = lines[n].split(mark)
    k = rng.randrange(len(cells))
    new = rng.choice(CELLS)
    was = cells[k].strip()
    cells[k] = new
    lines[n] = mark.join(cells)
    numeric = bool(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", was))
    wrong = numeric and new in NO_NUMBERS
    return Mutant(
        "\n".join(lines).encode(), f"cell {k} of line {n + 1}: {new[:40]!r}", wrong, n + 1
    )


def table_row(data: bytes, rng: Random) -> Mutant:
    """A row with a cell more or less, repeated, or of 100,000."""
    lines, rows = rows_of(data)
    n = rng.choice(rows)
    mark = separator(lines[n])
    what = rng.choice(("longer", "shorter", "repeated", "many"))
    if what == "longer":
        lines[n] += f"{mark}1"
    elif what == "shorter":
        lines[n] = lines[n].rpartition(mark)[0]
    elif what == "repeated":
        lines.insert(n, lines[n])
    else:
        cells = lines[n].split(mark)
        more = [
            mark.join(
                str(round(rng.uniform(-2, 2), 6)) if i < 3 else cell
                for i, cell in enumerate(cells)
            )
            for _ in range(LONG)
        ]
        lines[n:n] = more
    return Mutant(
        "\n".join(lines).encode(), f"row {n + 1} {what}", line=0 if what == "many" else n + 1
    )


def table_head(data: bytes, rng: Random) -> Mutant:
    """A name of a column misspelled, repeated, left out, exchanged; other separators; no rows."""
    lines, rows = rows_of(data)
    n = rows[0]
    mark = separator(lines[n])
    names = lines[n].split(mark)
    k = rng.randrange(len(names))
    what = rng.choice(
        (
            "misspelled",
            "repeated",
            "left out",
            "exchanged",
            "semicolons",
            "no rows",
            "no names",
        )
    )
    if what == "misspelled":
        names[k] = f"{names[k]}x"
    elif what == "repeated":
        names[k] = names[0]
    elif what == "left out":
        del names[k]
    elif what == "exchanged":
        names[k], names[0] = names[0], names[k]
    lines[n] = mark.join(names)
    if what == "semicolons":
        lines = [line.replace(",", ";") for line in lines]
    elif what == "no rows":
        lines = lines[: n + 1]
    elif what == "no names":
        del lines[n]
    return Mutant("\n".join(lines).encode(), f"names {what}")


TABLE = tuple(
    guarded(one, flipped)
    for one in (table_cell, table_cell, table_cell, table_row, table_head)
)


# XML, JSON, notation of keywords


def token(data: bytes, rng: Random) -> Mutant:
    """Another number or word in the place of one, in text of any notation."""
    text = data.decode()
    found = list(re.finditer(r"[-+]?\d[\d.eE+-]*|[A-Za-z_]\w*", text))
    hit = rng.choice(found)
    new = rng.choice((*CELLS, "-5", "1e12", "9999-12-31T23:59:59", "[1]", "null", "{}"))
    what = f"{hit[0][:30]} = {new[:40]!r}"
    return Mutant(f"{text[: hit.start()]}{new}{text[hit.end() :]}".encode(), what)


def xml_part(data: bytes, rng: Random) -> Mutant:
    """An attribute of another value, left out or repeated; an element left out, repeated, or nested deep."""
    text = data.decode()
    what = rng.choice(
        ("value", "value", "value", "attribute", "element", "nested", "entities", "include")
    )
    if what in ("value", "attribute"):
        hit = rng.choice(list(re.finditer(r'\s(\w+)="([^"]*)"', text)))
        new = rng.choice(
            (
                "",
                "nan",
                "inf",
                "1e300",
                "-1",
                "0",
                "1e-320",
                "text",
                "1 2",
                "☃",
                "x" * 5000,
                "0 0 0",
            )
        )
        if what == "attribute":
            return Mutant(
                (text[: hit.start()] + text[hit.end() :]).encode(), f"no {hit[0][:60]}"
            )
        return Mutant(
            (text[: hit.start(2)] + new + text[hit.end(2) :]).encode(),
            f"{hit[1]} = {new[:40]!r}",
        )
    if what == "element":
        hit = rng.choice(list(re.finditer(r"<\w[^<>]*/>", text)))
        times = rng.choice((0, 2, 3000))
        return Mutant(
            (text[: hit.start()] + hit[0] * times + text[hit.end() :]).encode(),
            f"{hit[0][:60]} x{times}",
        )
    if what == "nested":
        at = text.index("<worldbody>") + len("<worldbody>")
        return Mutant(
            (text[:at] + "<body>" * 3000 + "</body>" * 3000 + text[at:]).encode(), what
        )
    if what == "include":
        return Mutant(
            text.replace(
                "<worldbody>", '<include file="vehicle.xml"/><worldbody>', 1
            ).encode(),
            what,
        )
    head = "<!DOCTYPE m [<!ENTITY a 'aaaaaaaaaa'>" + "".join(
        f"<!ENTITY a{n} '{f'&a{n - 1};' * 10 if n else '&a;' * 10}'>" for n in range(9)
    )
    return Mutant((head + "]>" + text.replace('model="', 'model="&a8;', 1)).encode(), what)


def json_value(data: bytes, rng: Random) -> Mutant:
    """Another value of a JSON text."""
    tree = json.loads(data)
    found: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        for key, value in (
            node.items()
            if isinstance(node, dict)
            else enumerate(node)
            if isinstance(node, list)
            else ()
        ):
            found.append((node, key))
            visit(value)

    visit(tree)
    node, key = rng.choice(found)
    new = rng.choice(
        (
            None,
            True,
            -1,
            0,
            1e300,
            math.inf,
            math.nan,
            "text",
            "",
            [],
            {},
            [1],
            "☃" * 900,
            10**40,
            [0] * LONG,
        )
    )
    if rng.random() < 0.15:
        del node[key]
    else:
        node[key] = new
    return Mutant(json.dumps(tree).encode(), f"{key} = {str(new)[:40]}")


WORDS = tuple(guarded(one, flipped) for one in (token, token, token))
XML = tuple(guarded(one, flipped) for one in (xml_part, xml_part, xml_part, token))
JSON = tuple(guarded(one, flipped) for one in (json_value, json_value, token))


# Images


def fits_card(data: bytes, rng: Random) -> Mutant:
    """Another value of a card of a FITS header, or a card more."""
    cards = max(data.find(b"END" + b" " * 77) // 80, 1)
    key = rng.choice(
        [
            "SIMPLE",
            "BITPIX",
            "NAXIS",
            "NAXIS1",
            "NAXIS2",
            "BZERO",
            "BSCALE",
            "BLANK",
            "EXTEND",
            "ROWORDER",
            "DATE-OBS",
            "EXPTIME",
            "CCD-TEMP",
            "BAYERPAT",
            "GCOUNT",
            "PCOUNT",
            "ZIMAGE",
            "CTYPE1",
            "CRVAL1",
            "TFIELDS",
            "CHECKSUM",
        ]
    )
    value = rng.choice(
        (
            "T",
            "F",
            "0",
            "1",
            "-1",
            "8",
            "16",
            "-32",
            "-64",
            "999",
            "1E300",
            "1E-300",
            "NaN",
            "9" * 18,
            "'RGGB'",
            "'☃'",
        )
    )
    at = 80 * next(
        (n for n in range(cards) if data[80 * n :].startswith(key.encode().ljust(8))),
        rng.randrange(cards),
    )
    card = f"{key:8s}= {value:>20s}".encode()[:80].ljust(80)
    return Mutant(data[:at] + card + data[at + 80 :], f"{key} = {value[:30]}")


def pixels(rng: Random) -> tuple[np.ndarray, str]:
    """An array that is no usual frame."""
    shape = rng.choice(
        (
            (1, 1),
            (1, 500),
            (500, 1),
            (2, 2),
            (64, 48),
            (3, 64, 48),
            (64, 48, 4),
            (2, 64, 48),
            (0, 5),
            (64,),
            (),
        )
    )
    kind = rng.choice(
        [
            "u1",
            "u2",
            ">u2",
            "i2",
            "i4",
            "i8",
            "u8",
            "f2",
            "f4",
            "f8",
            ">f8",
            "c8",
            "?",
            "O",
            "S3",
            "M8[s]",
        ]
    )
    draw = np.random.default_rng(rng.randrange(1 << 30))
    image = draw.normal(300, 30, shape)
    what = rng.choice(
        ("noise", "zeros", "nan", "inf", "huge", "tiny", "negative", "some nan", "saturated")
    )
    values = {
        "noise": lambda: image,
        "zeros": lambda: image * 0,
        "nan": lambda: image * np.nan,
        "inf": lambda: image + np.inf,
        "huge": lambda: image * 1e300,
        "tiny": lambda: image * 1e-310,
        "negative": lambda: -image,
        "some nan": lambda: np.where(
            draw.random(shape) < 0.1, rng.choice((np.nan, np.inf, -np.inf)), image
        ),
        "saturated": lambda: image * 0 + 65535,
    }
    with np.errstate(all="ignore"):
        made = np.asarray(values[what]())
        return made.astype(kind), f"{what} {kind} {shape}"


def npy_array(data: bytes, rng: Random) -> Mutant:
    """An NPY file of any type and shape."""
    array, what = pixels(rng)
    buffer = io.BytesIO()
    np.save(buffer, array)
    return Mutant(buffer.getvalue(), what)


def fits_array(data: bytes, rng: Random) -> Mutant:
    """A FITS file of any type and shape that the format has."""
    array, what = pixels(rng)
    kind = array.dtype.kind if array.ndim and array.size else ""
    if kind not in "uif" or (array.dtype.itemsize == 2 and kind == "f") or not kind:
        return fits_card(data, rng)
    buffer = io.BytesIO()
    header = fits.Header([("ROWORDER", "TOP-DOWN")] if rng.random() < 0.7 else [])
    fits.PrimaryHDU(array, header).writeto(buffer)
    return Mutant(buffer.getvalue(), what)


FITS = (fits_card, fits_card, fits_array, flipped)
BINARY = (flipped, flipped, cut)


# SQLite


def database(data: bytes, rng: Random) -> Mutant:
    """A cell, a row, a column or a table of an SQLite file changed or left out."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.sqlite"
        path.write_bytes(data)
        with closing(sqlite3.connect(path, isolation_level=None)) as base:
            tables = [
                row[0]
                for row in base.execute("SELECT name FROM sqlite_master WHERE type='table'")
            ]
            table = rng.choice(tables)
            names = [row[1] for row in base.execute(f'PRAGMA table_info("{table}")')]
            name = rng.choice(names)
            new: Any = rng.choice(
                (
                    None,
                    -1,
                    0,
                    1e300,
                    math.inf,
                    "",
                    "text",
                    b"\xff\0",
                    2**62,
                    "☃" * 500,
                    "nan",
                    "[1]",
                    "{}",
                    '{"a": 1e999}',
                )
            )
            what = rng.choice(
                (
                    "value",
                    "value",
                    "value",
                    "values",
                    "row",
                    "rows",
                    "column",
                    "table",
                    "twice",
                )
            )
            some = f'WHERE rowid IN (SELECT rowid FROM "{table}" ORDER BY random() LIMIT 1)'
            try:
                base.execute("PRAGMA ignore_check_constraints=1")
                base.execute(
                    {
                        "value": f'UPDATE "{table}" SET "{name}"=? {some}',
                        "values": f'UPDATE "{table}" SET "{name}"=?',
                        "row": f'DELETE FROM "{table}" {some} AND ? IS NOT 7',
                        "rows": f'DELETE FROM "{table}" WHERE ? IS NOT 7',
                        "column": f'ALTER TABLE "{table}" RENAME COLUMN "{name}" TO other',
                        "table": f'DROP TABLE "{table}"',
                        "twice": f'INSERT INTO "{table}" SELECT * FROM "{table}" WHERE ? IS NOT 7',
                    }[what],
                    () if what in ("column", "table") else (new,),
                )
            except sqlite3.Error:
                return flipped(data, rng)
        return Mutant(path.read_bytes(), f"{table}.{name} {what} {str(new)[:30]}")


DATABASE = (database, database, database, flipped)


def chosen(mutations: Sequence[Mutation], data: bytes, rng: Random) -> Mutant:
    """One mutation of those of a kind of file, or in one case of five one of any file."""
    return rng.choice(ANY if rng.random() < 0.2 else mutations)(data, rng)
