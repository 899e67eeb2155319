"""Compressed FITS images are decoded, and damaged ones neither crash skysim nor keep it busy."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from skysim.core import guarded, images
from skysim.core.errors import InputError

PIXELS = np.random.default_rng(1).integers(0, 500, (60, 80)).astype(np.int16)


def compressed(kind: str = "HCOMPRESS_1") -> bytes:
    file = io.BytesIO()
    fits.HDUList(
        [fits.PrimaryHDU(), fits.CompImageHDU(PIXELS, compression_type=kind)]
    ).writeto(file)
    return file.getvalue()


def with_value(data: bytes, key: str, value: int) -> bytes:
    """The file with another integer in a key of its table's header."""
    begin = data.rindex(f"{key:8s}=".encode()) + 10
    return data[:begin] + f"{value:20d}".encode() + data[begin + 20 :]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["HCOMPRESS_1", "RICE_1"])
def test_a_compressed_image_is_decoded(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "x.fits"
    path.write_bytes(compressed(kind))
    np.testing.assert_array_equal(images.read_picture(path).pixels, PIXELS[::-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("ZNAXIS1", 75, "not a complete FITS file"),  # malloc(): invalid size
        ("ZNAXIS2", 30, "not a complete FITS file"),
        ("TFIELDS", 2**31 - 1, "TFIELDS 2147483647; allowed: up to 999 columns"),
        ("ZNAXIS", 2**31 - 1, "not a complete FITS file"),
        ("ZNAXIS2", 2**31 - 1, "2147483647x80 pixels by its header"),
    ],
)
def test_a_wrong_size_of_a_compressed_image_is_refused_in_one_line(
    tmp_path: Path, key: str, value: int, message: str
) -> None:
    path = tmp_path / "x.fits"
    path.write_bytes(with_value(compressed(), key, value))
    with pytest.raises(InputError, match=re.escape(f"{path}: {message}")) as refusal:
        images.read_image(path)
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "outcome"),
    [
        ("pass", ""),
        ("while True: pass", "it takes more than 1 s"),
        ("bytearray(1 << 40)", "it needs more than 512 MiB of memory"),
        ("import os; os.abort()", r"it crashes its reader (SIGABRT)"),
        ("import os; os.kill(os.getpid(), 9)", "it crashes its reader (SIGKILL)"),
        ("import sys; sys.exit('no\\nstars')", "stars"),
        ("import os; os._exit(3)", "its reader exits with code 3"),
    ],
)
def test_a_guarded_script_has_limits(tmp_path: Path, code: str, outcome: str) -> None:
    (tmp_path / "script.py").write_text(code)
    assert (
        guarded.run_guarded(tmp_path / "script.py", cpu_s=1, memory_bytes=1 << 29) == outcome
    )


@pytest.mark.parametrize("number", [0, 1])
def test_more_axes_than_the_standard_has_are_refused_at_once(
    tmp_path: Path, number: int
) -> None:
    """astropy makes a list of as many entries as the header says."""
    path = tmp_path / "axes.fits"
    fits.HDUList(
        [fits.PrimaryHDU(), fits.CompImageHDU(np.zeros((32, 32), np.int16))]
    ).writeto(path)
    data = path.read_bytes()
    start = [
        hit.start() for hit in re.finditer(b"NAXIS   = ", data) if hit.start() % 80 == 0
    ][number]
    path.write_bytes(data[: start + 10] + b"2147483647".rjust(20) + data[start + 30 :])
    with pytest.raises(
        InputError, match=r"axes\.fits: NAXIS 2147483647; allowed: up to 999 axes$"
    ):
        images.read_image(path)


def test_a_guarded_script_that_waits_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guarded, "WALL_S", 0.5)
    (tmp_path / "script.py").write_text("import time; time.sleep(60)")
    outcome = guarded.run_guarded(tmp_path / "script.py", cpu_s=1, memory_bytes=1 << 29)
    assert outcome == "it takes longer than 0.5 s"
