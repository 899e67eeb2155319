"""Every parser against random files: each is read or refused in one line."""

from __future__ import annotations

import bz2
import gzip
import io as streams
import lzma
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as some
from PIL import Image

from skysim.camera.psf.otf import read_cells
from skysim.core import encoded, images, yaml_reader
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.sources import photometry
from skysim.sources.dome import point_cloud
from skysim.sources.dome.layouts import listed
from tests.fuzz.__main__ import NAMES, TOKENS, mutate, seeds
from tests.fuzz.targets import TARGETS, rejects
from tests.helpers.hostile_files import promise

AS_IT_IS = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def test_every_target_has_a_corpus() -> None:
    assert list(TARGETS) == list(NAMES)
    assert all(seeds(name) for name in NAMES)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("files", [4, pytest.param(3000, marks=pytest.mark.long)])
def test_inputs_grown_from_the_corpus_are_read_or_refused_in_one_line(
    name: str, files: int
) -> None:
    rng = Random(2026)
    corpus = seeds(name)
    for data in corpus:
        TARGETS[name](data)
    for _ in range(files):
        TARGETS[name](mutate(rng.choice(corpus), corpus, rng))


EDITS = ("insert", "delete", "replace", "splice")
PLACE = some.floats(0, 1, allow_nan=False)  # of a file


def edited(data: bytes, edit: tuple[str, float, int, bytes], other: bytes) -> bytes:
    """A file with bytes inserted, deleted or replaced, or with the end of another file."""
    how, place, length, new = edit
    at = round(place * len(data))
    if how == "splice":
        return data[:at] + other[round(place * len(other)) :]
    return (
        data[:at]
        + (b"" if how == "delete" else new)
        + data[at + (0 if how == "insert" else length) :]
    )


@some.composite
def files_of(draw: some.DrawFn, name: str) -> bytes:
    """Any bytes, or a corpus or shipped file edited up to six times."""
    corpus = some.sampled_from(seeds(name))
    new = some.binary(max_size=16) | some.sampled_from(TOKENS)
    edit = some.tuples(some.sampled_from(EDITS), PLACE, some.integers(1, 60), new)
    if draw(some.integers(0, 5)) == 0:
        return draw(some.binary(max_size=400))
    data = draw(corpus)
    for one in draw(some.lists(edit, min_size=1, max_size=6)):
        data = edited(data, one, draw(corpus))
    return data


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("examples", [6, pytest.param(300, marks=pytest.mark.long)])
def test_any_file_is_read_or_refused_in_one_line(name: str, examples: int) -> None:
    """Drawn by hypothesis, which looks for the smallest file that is not."""

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=examples < 100,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(files_of(name))
    def holds(data: bytes) -> None:
        TARGETS[name](data)

    holds()


# YAML


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (
            "\n".join(
                f"a{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 9)}]"
                for n in range(9)
            ),
            "values",
        ),
        ("a: " + "[" * 60 + "]" * 60, "sections deep"),
        ("a: &a [*a]", "an alias within its own anchor"),
        ("a: 2001-99-99", "is not a valid timestamp"),
        ("a: " + "9" * 5000, "is not a valid int"),
        ("a: !!python/name:os.system", "tag"),
    ],
    ids=["laughs", "deep", "itself", "date", "digits", "code"],
)
def test_yaml_with_unsafe_constructs_is_refused(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"x\.yaml, line \d: not YAML: .*{what}"):
        yaml_reader.read_yaml(tmp_path / "x.yaml")


def test_yaml_keeps_aliases_and_merges(tmp_path: Path) -> None:
    text = "a: &a {b: 1, c: [2, 3]}\nd: {<<: *a, b: 4}\ne: *a\n"
    _, values = yaml_reader.parse_yaml(text)
    assert values == {
        "a": {"b": 1, "c": [2, 3]},
        "d": {"b": 4, "c": [2, 3]},
        "e": {"b": 1, "c": [2, 3]},
    }


def test_a_yaml_file_of_megabytes_is_refused_unread(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_bytes(b"#" * (yaml_reader.MAX_BYTES + 1))
    with pytest.raises(
        InputError, match=f"{yaml_reader.MAX_BYTES + 1} bytes; allowed: up to"
    ):
        yaml_reader.read_yaml(tmp_path / "x.yaml")


@pytest.mark.parametrize(
    "overrides",
    [
        {"exposure.frames": "1000000000"},
        {"exposure.frames": "5000", "exposure.rate_hz": "0.01"},
    ],
)
def test_a_flight_too_long_for_memory_is_refused(overrides: dict[str, str]) -> None:
    with pytest.raises(InputError, match="allowed: up to 1000000, over a day"):
        loader.load("shefex2", overrides)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    some.dictionaries(some.text(min_size=1, max_size=30), some.text(max_size=30), max_size=3)
)
def test_any_override_is_taken_or_refused(overrides: dict[str, str]) -> None:
    rejects(lambda: loader.load("shefex2", overrides), InputError)


# Tables


TABLES: dict[str, Callable[[Path], object]] = {
    "a, b, c": lambda path: point_cloud.read(str(path), "m"),
    "x_m,y_m,z_m,magnitude": listed.read_csv,
    "azimuth_deg,tilt_deg,level": listed.read_csv,
    "wavelength_nm,response": photometry._read_curve,
    "1,2,3": lambda path: read_cells(str(path)),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:loadtxt")
@pytest.mark.parametrize("head", TABLES)
@AS_IT_IS
@given(some.lists(some.lists(some.floats() | some.text(max_size=6), max_size=5), max_size=3))
def test_any_table_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, head: str, rows: list[list[object]]
) -> None:
    """Points of a dome, LEDs, a quantum efficiency, a point-spread function."""
    path = tmp_path_factory.mktemp("table") / "x.csv"
    path.write_text(
        "\n".join([head, *(",".join(map(str, row)) for row in rows)]), encoding="utf-8"
    )
    rejects(lambda: TABLES[head](path), InputError)


# Pictures that promise too much


@pytest.mark.parametrize("side", [20_000, 60_000])
@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".jpg", ".fits"])
def test_a_header_of_gigapixels_is_refused_before_decoding(
    tmp_path: Path, suffix: str, side: int
) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(promise(suffix, side, side) + b"\0" * 999)
    with pytest.raises(
        InputError, match=r"\d+x\d+ pixels by its header; allowed: up to 268435456|truncated"
    ):
        images.read_image(path)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".jpg"])
def test_sizes_are_read_as_opencv_writes_them(suffix: str, tmp_path: Path) -> None:
    data = cv2.imencode(suffix, np.zeros((30, 41), np.uint8))[1].tobytes()
    read = next(reader for magic, reader in encoded.FORMATS.items() if data.startswith(magic))
    assert list(read(data)) == [((41, 30), 1)]


def test_every_sample_of_a_tiff_s_pixels_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four doubles a pixel are sixteen times what two bytes are."""
    monkeypatch.setattr(encoded, "MAX_PIXELS", 30 * 41)
    path = tmp_path / "x.tiff"
    gray = np.arange(30 * 41.0).reshape(30, 41)
    cv2.imwrite(str(path), gray)
    assert np.array_equal(images.read_image(path), gray)
    cv2.imwrite(str(path), np.dstack([gray] * 4))
    with pytest.raises(InputError, match="41x30x4 pixels by its header"):
        images.read_image(path)


def pillow_bytes(mode: str, kind: str, **options: Any) -> bytes:
    """An image of 41 x 30 pixels as Pillow writes it."""
    buffer = streams.BytesIO()
    Image.new(mode, (41, 30)).save(buffer, kind, **options)
    return buffer.getvalue()


ENCODED = [
    *(
        cv2.imencode(suffix, np.zeros((30, 41, 4), of))[1].tobytes()
        for suffix in (".png", ".tiff")
        for of in "BH"
    ),
    *(cv2.imencode(".tiff", np.zeros((30, 41), of))[1].tobytes() for of in "Bfd"),
    *(pillow_bytes(mode, "PNG") for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16")),
    *(pillow_bytes(mode, "TIFF") for mode in ("1", "L", "RGB", "RGBA", "I;16", "F")),
    *(pillow_bytes(mode, "JPEG") for mode in ("L", "RGB", "CMYK")),
    *(
        pillow_bytes("RGB", kind, **options)
        for kind, options in (("BMP", {}), ("TIFF", {"big_tiff": True}))
    ),
]


@pytest.mark.parametrize("data", ENCODED)
def test_no_image_takes_more_memory_than_its_header_says(data: bytes) -> None:
    """And at most twice less: OpenCV may add an alpha channel to a palette, and leave one out."""
    read = next(reader for magic, reader in encoded.FORMATS.items() if data.startswith(magic))
    ((sides, each_bytes),) = read(data)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded.nbytes <= np.prod(sides) * each_bytes <= 2 * decoded.nbytes


def test_a_png_of_zeros_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    """16384 x 16384 pixels of 8 bytes in 2 MB; read, they took 4.3 GB and half a minute."""
    header = struct.pack(">IIBBBBB", 16384, 16384, 16, 6, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", bytes(2_100_000)), (b"IEND", b""))
    packed = (struct.pack(">I", len(data)) + kind + data + bytes(4) for kind, data in chunks)
    path = tmp_path / "x.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))
    with pytest.raises(
        InputError,
        match=r"16384x16384 pixels of 2147483648 bytes by its header; allowed: up to",
    ):
        images.read_image(path)


@pytest.mark.parametrize("kind", [6, 8, 9, 17])
def test_a_tiff_s_sides_count_as_libtiff_reads_them(tmp_path: Path, kind: int) -> None:
    """Signed, and the first of two; here a BigTIFF, whose entries hold any type."""
    side = 100 if kind == 6 else 30_000

    def entry(tag: int, of: int, value: int) -> bytes:
        return struct.pack("<HHQQ", tag, of, 1, value)

    sides = b"".join(
        entry(tag, of, value) for tag in (256, 257) for of, value in ((kind, side), (4, 2))
    )
    data = b"II" + struct.pack("<HHHQQ", 43, 8, 0, 16, 4) + sides
    assert list(encoded.tiff_size(data)) == [((side, side), 1)]


@pytest.mark.parametrize("between", [b"\xff\xd0", b"\xff\x01", b"\xff\x00"])
def test_no_marker_hides_a_jpeg_s_size(tmp_path: Path, between: bytes) -> None:
    """To libjpeg these are a mark without a length, or nothing: what they seem to skip, it reads."""
    path = tmp_path / "x.jpg"
    small = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
    at = small.index(b"\xff\xc0")
    great = small[2 : at + 5] + struct.pack(">HH", 17_000, 17_000) + small[at + 9 :]
    skipped = 4 + struct.unpack(">H", great[:2])[0]
    path.write_bytes(
        (small[:2] + between + great).ljust(skipped, b"\0") + small[at:] + bytes(9)
    )
    with pytest.raises(
        InputError, match=r"17000x17000 pixels by its header|cannot be decoded"
    ):
        images.read_image(path)


@pytest.mark.parametrize("kind", ["stream", "tiles"])
def test_fits_that_unpacks_to_gigapixels_is_refused(tmp_path: Path, kind: str) -> None:
    """Two gigapixels of zeros in some kilobytes: gzipped, or with a table of tiles that claims them."""
    path = tmp_path / "x.fits"
    if kind == "stream":
        path.write_bytes(gzip.compress(promise(".fits", 40_000, 50_000) + b"\0" * 2880))
    else:
        buffer = streams.BytesIO()
        fits.HDUList(
            [fits.PrimaryHDU(), fits.CompImageHDU(np.zeros((20, 20), np.int16))]
        ).writeto(buffer)
        data = buffer.getvalue()
        for key, of in (("ZNAXIS1", 40_000), ("ZNAXIS2", 50_000)):
            at = data.index(key.encode())
            data = data[: at + 10] + f"{of:20d}".encode() + data[at + 30 :]
        path.write_bytes(data)
    with pytest.raises(
        InputError, match=r"50000x40000 pixels by its header|not a complete FITS"
    ):
        images.read_image(path)


@pytest.mark.parametrize("packer", [gzip, bz2, lzma])
def test_packed_fits_is_refused_before_it_is_unpacked(tmp_path: Path, packer: Any) -> None:
    """A header of blanks has no end: two gigabytes of them in some kilobytes took minutes, and all memory."""
    path = tmp_path / "x.fits"
    path.write_bytes(packer.compress(b"SIMPLE  =".ljust(1 << 20)))
    with pytest.raises(InputError, match="begins with SIMPLE, not compressed"):
        images.read_image(path)


def test_an_unsupported_format_that_opencv_reads_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(b"Pf\n2 2\n-1.0\n" + bytes(16))  # portable floats
    with pytest.raises(InputError, match="cannot be decoded"):
        images.read_image(tmp_path / "x.png")
