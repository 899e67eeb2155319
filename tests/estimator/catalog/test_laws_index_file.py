"""The index of quads on disk: what is read is what was built, whatever has happened to the file."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from estimator.catalog import index_file, quad_index, sky_index
from estimator.catalog.quad_index import QuadIndex
from estimator.catalog.sky_index import SkyIndex
from tests.helpers.laws import SEEDS, law

HEIGHT_RAD = 0.9


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An own folder, in which small skies are kept too."""
    monkeypatch.setenv("ESTIMATOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(index_file, "FEW_STARS", 0)
    return tmp_path


def random_sky(rng: np.random.Generator, count: int = 60) -> SkyIndex:
    vectors = rng.standard_normal((count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return sky_index.build(vectors, np.linspace(0, 6, count))


def assert_same(one: QuadIndex, other: QuadIndex) -> None:
    for name in QuadIndex._fields:
        first, second = getattr(one, name), getattr(other, name)
        np.testing.assert_array_equal(first, second)
        # One compiled version accepts both.
        assert (first.dtype, first.flags.behaved) == (second.dtype, second.flags.behaved)


@law(index_file.quads, index_file.read, index_file.folder, index_file.release)
@given(rng=SEEDS, height_rad=some.floats(0.3, 1.2))
def test_the_second_start_reads_what_the_first_one_built(
    rng: np.random.Generator, height_rad: float
) -> None:
    sky = random_sky(rng)
    built = quad_index.build(sky, height_rad)
    assert_same(index_file.quads(sky, height_rad), built)
    with patch.object(quad_index, "build", side_effect=AssertionError):
        assert_same(index_file.quads(sky, height_rad), built)
    newest = max(index_file.folder().glob("*.bin"), key=lambda path: path.stat().st_mtime_ns)
    mapped = index_file.read(newest)
    index_file.release()
    assert_same(mapped, built)


def resident_bytes(path: Path) -> int:
    """The memory that the kernel counts for the maps of a file in this process."""
    lines = Path("/proc/self/smaps").read_text().splitlines()
    starts = [n for n, line in enumerate(lines) if line.endswith(str(path))]
    sizes = [next(line for line in lines[n:] if line.startswith("Rss:")) for n in starts]
    return sum(1024 * int(line.split()[1]) for line in sizes)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's figures are Linux's")
def test_released_pages_are_no_memory_and_are_read_again(folder: Path) -> None:
    _, path = first_file(folder)
    index = index_file.read(path)
    dropped = index_file.read(path)
    copies = [part.copy() for part in index]
    assert resident_bytes(path) > 0.9 * path.stat().st_size
    del dropped  # a map that is gone is not asked for
    index_file.release()
    assert resident_bytes(path) == 0
    for part, copy in zip(index, copies, strict=True):
        np.testing.assert_array_equal(part, copy)


def first_file(folder: Path) -> tuple[SkyIndex, Path]:
    sky = random_sky(np.random.default_rng(1))
    index_file.quads(sky, HEIGHT_RAD)
    return sky, next(folder.glob("*.bin"))


@pytest.mark.parametrize("damage", ["empty", "short", "bit", "last", "other"])
def test_a_damaged_file_is_written_again(folder: Path, damage: str) -> None:
    sky, path = first_file(folder)
    whole = path.read_bytes()
    bit = bytearray(whole)
    bit[len(whole) // 3] ^= 4
    last = bytearray(whole)
    last[-1] ^= 128
    path.write_bytes(
        {
            "empty": b"",
            "short": whole[:-16],
            "bit": bytes(bit),
            "last": bytes(last),
            "other": b"something else" * 50_000,
        }[damage]
    )
    assert_same(index_file.quads(sky, HEIGHT_RAD), quad_index.build(sky, HEIGHT_RAD))
    assert path.read_bytes() == whole


def test_another_sky_or_field_has_another_file(folder: Path) -> None:
    sky, _ = first_file(folder)
    moved = sky.vectors.copy()
    moved[7] = moved[8]
    other = sky._replace(vectors=moved)
    for one, height_rad in ((other, HEIGHT_RAD), (sky, 0.5)):
        assert_same(index_file.quads(one, height_rad), quad_index.build(one, height_rad))
    assert len(list(folder.glob("*.bin"))) == 3


def test_only_the_newest_files_are_kept(folder: Path) -> None:
    sky = random_sky(np.random.default_rng(2))
    for height_rad in np.linspace(0.3, 1.2, index_file.MOST_FILES + 3):
        index_file.quads(sky, float(height_rad))
    assert len(list(folder.iterdir())) == index_file.MOST_FILES
    with patch.object(quad_index, "build", side_effect=AssertionError):
        index_file.quads(sky, 1.2)


def test_without_a_folder_the_index_is_built(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "file").touch()
    monkeypatch.setenv("ESTIMATOR_CACHE_DIR", str(folder / "file" / "below"))
    sky = random_sky(np.random.default_rng(3))
    assert_same(index_file.quads(sky, HEIGHT_RAD), quad_index.build(sky, HEIGHT_RAD))


def test_several_may_start_at_once(folder: Path) -> None:
    sky = random_sky(np.random.default_rng(4))
    built = quad_index.build(sky, HEIGHT_RAD)
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda _: index_file.quads(sky, HEIGHT_RAD), range(24)):
            assert_same(found, built)
    assert len(list(folder.iterdir())) == 1


def test_the_folder_is_the_user_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ESTIMATOR_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert index_file.folder() == Path("/somewhere/estimator")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert index_file.folder() == Path.home() / ".cache/estimator"


def test_small_catalogs_are_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_file, "FEW_STARS", 61)
    sky = random_sky(np.random.default_rng(5))
    assert_same(index_file.quads(sky, HEIGHT_RAD), quad_index.build(sky, HEIGHT_RAD))
    assert not list(folder.iterdir())
