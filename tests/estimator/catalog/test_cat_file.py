"""Files .CAT: an entry by hand, what is kept of a catalog, and damaged files."""

from pathlib import Path

import numpy as np
import pytest

from estimator.catalog import cat_file, catalog
from estimator.catalog.published_catalogs import OnBoard, proc_cat, read_cat
from estimator.core.errors import ImageError

FILE = Path(__file__).parents[3] / "data/catalogs/hipparcos_hp6.5.ecsv"
ARCSEC_RAD = np.pi / 648_000
# ra 90 deg = 2^30, dec -45 deg = -2^29, 5.25 mag = 0x501BD0, id 7, of 2 stars. Its words add up to 0x13C29, and
# 0x10000 - 0x3C29 = 0xC3D7.
ENTRY = "00000040 000000e0 d01b5000 07000000 0200 d7c3"


def one_star() -> OnBoard:
    vectors = np.array([[0.0, np.sqrt(0.5), -np.sqrt(0.5)]])
    return OnBoard(np.array([7]), vectors, np.array([5.25]), np.array([2]), 2010.5)


def test_an_entry_has_the_bytes_worked_out_by_hand() -> None:
    data = cat_file.encode(one_star())
    assert data[:20] == b"SKYSIM.CAT\0\0" + bytes.fromhex("84ad1e00 01000000")  # 2,010,500; 1
    assert data[20:] == bytes.fromhex(ENTRY)


def test_a_catalog_survives_the_file_to_half_a_unit(tmp_path: Path) -> None:
    stars = proc_cat(read_cat(FILE, 5.0, 2010.0), 60 * ARCSEC_RAD)
    path = tmp_path / "bright.cat"
    path.write_bytes(cat_file.encode(stars))
    same = cat_file.read(path)
    np.testing.assert_array_equal(same.id, stars.id)
    np.testing.assert_array_equal(same.components, stars.components)
    np.testing.assert_allclose(same.magnitude, stars.magnitude, rtol=0, atol=0.5e-6)
    # Half a unit, 2 pi / 2^33, in each angle.
    off_rad = np.linalg.norm(same.vectors - stars.vectors, axis=1).max()
    assert off_rad <= np.sqrt(2) * np.pi / 2**32
    assert same.epoch_yr == stars.epoch_yr
    assert cat_file.encode(same) == path.read_bytes()


def test_the_last_right_ascension_before_a_whole_turn_is_zero(tmp_path: Path) -> None:
    stars = OnBoard(
        np.array([1]), np.array([[1.0, -1e-12, 0.0]]), np.zeros(1), np.ones(1, int), 2000.0
    )
    (tmp_path / "x.cat").write_bytes(cat_file.encode(stars))
    assert cat_file.read(tmp_path / "x.cat").vectors[0].tolist() == [1.0, 0.0, 0.0]


def test_a_tracker_gets_the_stars_at_rest_at_the_file_s_epoch(tmp_path: Path) -> None:
    raw = read_cat(FILE, 3.0, 2010.0)
    (tmp_path / "x.cat").write_bytes(cat_file.encode(raw))
    stars = cat_file.read_stars(tmp_path / "x.cat")
    assert np.all(np.diff(stars.v_mag) >= 0)
    np.testing.assert_array_equal(
        catalog.at_epoch(stars, 2030.0), catalog.at_epoch(stars, 2010)
    )


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (
            lambda data: data[:30] + bytes([data[30] ^ 1]) + data[31:],
            "wrong checksum of entry 0",
        ),
        (lambda data: data[:-1], "39 bytes for 1 entries"),
        (lambda data: b"PTASE" + data[5:], "its header is another"),
        (lambda data: data[:15], "its header is another"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, damage, complaint: str) -> None:
    path = tmp_path / "x.cat"
    path.write_bytes(damage(cat_file.encode(one_star())))
    with pytest.raises(ImageError, match=complaint):
        cat_file.read(path)
