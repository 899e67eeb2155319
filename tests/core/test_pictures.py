"""Images oriented as viewed: EXIF orientation, FITS row orders, packed and color FITS, planar TIFF."""

from __future__ import annotations

import datetime
import gzip
import io
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image, ImageOps

from skysim.core import encoded, images
from skysim.core.errors import InputError
from skysim.experiments.characterize import frame_files
from skysim.scene import loader
from skysim.tracking import tracker_interface

RNG = np.random.default_rng(4)
# Blocks, which JPEG keeps.
GRAY = np.kron(RNG.integers(0, 255, (5, 7), np.uint8), np.ones((8, 8), np.uint8))
# Exif 2.32, tables 4 to 8
ORIENTATION = 0x0112
EXIF = 0x8769
FOCAL_35MM = 0xA405


def with_exif(
    path: Path, image: NDArray, orientation: int | None, focal_35mm: int | None = None
) -> Path:
    """Write an image by Pillow with these tags."""
    exif = Image.Exif()
    if orientation is not None:
        exif[ORIENTATION] = orientation
    if focal_35mm is not None:
        exif.get_ifd(EXIF)[FOCAL_35MM] = focal_35mm
    written = Image.Exif()
    # Without this, Pillow leaves the inner directory out of a TIFF file.
    written.load(exif.tobytes())
    Image.fromarray(image).save(
        path, exif=written, **({"quality": 95} if path.suffix == ".jpg" else {})
    )
    return path


def complaint(path: Path, read: Callable[[Path], object] = images.read_picture) -> str:
    with pytest.raises(InputError) as refusal:
        read(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message


# EXIF


@pytest.mark.parametrize("orientation", [None, *range(1, 9), 9])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("color", [False, True], ids=["gray", "color"])
def test_an_image_is_read_upright_like_pillow(
    tmp_path: Path, suffix: str, orientation: int | None, color: bool
) -> None:
    """OpenCV leaves JPEG and PNG as stored and turns TIFF; Pillow's `exif_transpose` is another implementation."""
    path = with_exif(
        tmp_path / f"x{suffix}",
        np.dstack([GRAY, GRAY[::-1], GRAY]) if color else GRAY,
        orientation,
    )
    # By its path, Pillow does not turn a gray TIFF.
    with Image.open(io.BytesIO(path.read_bytes())) as stored:
        shown = np.asarray(ImageOps.exif_transpose(stored))
    seen = images.read_picture(path).pixels
    assert seen.shape == shown.shape
    assert seen.flags["C_CONTIGUOUS"]
    # Two JPEG decoders.
    np.testing.assert_allclose(seen[..., ::-1] if color else seen, shown, atol=2)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_undoes_the_orientation_tag(orientation: int) -> None:
    """Exif 2.32, Orientation: where the 0th row and the 0th column of the stored picture are in the seen one."""
    seen = np.arange(6).reshape(2, 3)
    stored = {
        1: seen,  # top, left
        2: seen[:, ::-1],  # top, right
        3: seen[::-1, ::-1],  # bottom, right
        4: seen[::-1],  # bottom, left
        5: seen.T,  # left, top
        6: seen[:, ::-1].T,  # right, top: its first row is the last column, from the top
        7: seen[::-1, ::-1].T,  # right, bottom
        8: seen[::-1].T,  # left, bottom
    }[orientation]
    np.testing.assert_array_equal(encoded.upright(stored, orientation), seen)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_the_focal_length_of_35_mm_film_is_read(tmp_path: Path, suffix: str) -> None:
    assert (
        images.read_picture(with_exif(tmp_path / f"x{suffix}", GRAY, 1, 26)).focal_35mm == 26
    )
    assert images.read_picture(with_exif(tmp_path / f"y{suffix}", GRAY, 6)).focal_35mm is None
    # 0: unknown.
    assert (
        images.read_picture(with_exif(tmp_path / f"z{suffix}", GRAY, 6, 0)).focal_35mm is None
    )


def exif_block(order: str, *entries: tuple[int, int, int, int], first: int = 8) -> bytes:
    """A TIFF structure of one directory with (tag, type, count, value) entries."""
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, first)
    body = b"".join(struct.pack(f"{order}HHII", *entry) for entry in entries)
    return head + struct.pack(f"{order}H", len(entries)) + body


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        (b"", encoded.Exif()),
        (b"rubbish", encoded.Exif()),
        (b"II*\0", encoded.Exif()),
        (exif_block("<", (ORIENTATION, 3, 1, 6)), encoded.Exif(6)),
        (exif_block(">", (ORIENTATION, 3, 1, 8 << 16)), encoded.Exif(8)),
        (exif_block("<", (ORIENTATION, 3, 1, 0)), encoded.Exif()),
        (exif_block("<", (ORIENTATION, 3, 1, 99)), encoded.Exif()),
        (exif_block("<", (ORIENTATION, 2, 1, 6)), encoded.Exif()),  # text
        (
            exif_block("<", (ORIENTATION, 3, 1, 6), (EXIF, 4, 1, 8)),
            encoded.Exif(6),
        ),  # the directory contains itself
        (
            exif_block("<", (ORIENTATION, 3, 1, 6), (EXIF, 4, 1, 2**32 - 1)),
            encoded.Exif(6),
        ),  # beyond the end
        (exif_block("<", first=2**32 - 1), encoded.Exif()),
    ],
)
def test_a_damaged_exif_block_is_ignored(block: bytes, expected: encoded.Exif) -> None:
    assert encoded.read_exif_block(block) == expected
    for end in range(len(block)):
        encoded.read_exif_block(block[:end])


def test_a_wrong_exif_block_does_not_prevent_reading(tmp_path: Path) -> None:
    """65,535 entries that all point to one another take no time and no memory: only two tags are followed."""
    data = bytearray(with_exif(tmp_path / "x.png", GRAY, 6).read_bytes())
    at = data.index(b"eXIf") + 4
    data[at + 8 : at + 10] = b"\xff\xff"  # little-endian or not
    (tmp_path / "x.png").write_bytes(data)
    assert images.read_picture(tmp_path / "x.png").pixels.size == GRAY.size


@pytest.mark.filterwarnings("error")
def test_pillow_prints_no_warning_about_damaged_exif(tmp_path: Path) -> None:
    """A text of 4,000 characters in a block of a hundred."""
    data = bytearray(with_exif(tmp_path / "x.jpg", GRAY, 6, 26).read_bytes())
    at = (
        data.index(struct.pack("<HHI", EXIF, 4, 1))
        if b"II*" in data
        else data.index(struct.pack(">HHI", EXIF, 4, 1))
    )
    order = "<" if b"II*" in data else ">"
    data[at : at + 12] = struct.pack(f"{order}HHII", 270, 2, 4000, 8)
    (tmp_path / "x.jpg").write_bytes(data)
    assert images.read_picture(tmp_path / "x.jpg").pixels.shape == GRAY.T.shape


# FITS


FRAME = RNG.integers(0, 60_000, (6, 9), np.uint16)


def fits_file(path: Path, pixels: NDArray, **cards: Any) -> Path:
    fits.PrimaryHDU(pixels, fits.Header(list(cards.items()))).writeto(path)
    return path


def test_the_last_row_is_the_top_by_default(tmp_path: Path) -> None:
    """FITS standard 4.0, section 3.3.1 and the pictures of every viewer; ROWORDER is Siril's and N.I.N.A.'s keyword."""
    for n, (order, highest_first, known) in enumerate(
        [
            ("TOP-DOWN", True, True),
            ("BOTTOM-UP", False, True),
            (None, False, False),
            ("sideways", False, False),
        ]
    ):
        path = fits_file(
            tmp_path / f"{n}.fits", FRAME, **({"ROWORDER": order} if order else {})
        )
        picture = images.read_picture(path)
        np.testing.assert_array_equal(picture.pixels, FRAME if highest_first else FRAME[::-1])
        assert picture.row_order_known is known
        # A reader that cannot try both has the same picture or none.
        if known:
            np.testing.assert_array_equal(images.read_image(path), picture.pixels)
        else:
            assert "no ROWORDER in the header; allowed: TOP-DOWN or BOTTOM-UP" in (
                complaint(path, images.read_image)
            )


@pytest.mark.parametrize("name", ["x.fits.gz", "x.FIT.GZ", "a.b.fts.gz"])
def test_a_gzipped_file_is_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(
        gzip.compress(fits_file(tmp_path / "x.fits", FRAME, ROWORDER="TOP-DOWN").read_bytes())
    )
    np.testing.assert_array_equal(images.read_picture(path).pixels, FRAME)


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True], ids=["fz", "fz in gz"])
def test_a_file_of_tiles_is_read_with_its_header(tmp_path: Path, packed: bool) -> None:
    header = fits.Header([("ROWORDER", "TOP-DOWN"), ("DATE-OBS", "2012-06-22T21:00:00")])
    path = tmp_path / "x.fits.fz"
    fits.HDUList(
        [
            fits.PrimaryHDU(),
            fits.CompImageHDU(np.kron(FRAME, np.ones((5, 5), np.uint16)), header),
        ]
    ).writeto(path)
    if packed:
        path = path.rename(tmp_path / "y.fits.gz")
        path.write_bytes(gzip.compress(path.read_bytes()))
    picture = images.read_picture(path)
    np.testing.assert_array_equal(picture.pixels[::5, ::5], FRAME)
    assert (picture.row_order_known, picture.date_utc) == (
        True,
        datetime.datetime(2012, 6, 22, 21),
    )


@pytest.mark.parametrize("kind", ["i2", "u2", "i4", "f4", "f8", "u1"])
def test_color_cubes_of_both_axis_orders_give_the_same_image(
    tmp_path: Path, kind: str
) -> None:
    """Red first; ITU-R BT.601: .299 R + .587 G + .114 B."""
    rgb = np.random.default_rng(1).integers(0, 250, (6, 9, 3)).astype(kind)
    expected = rgb @ [0.299, 0.587, 0.114]
    for name, cube in (("planes", np.moveaxis(rgb, 2, 0)), ("pixels", rgb)):
        picture = images.read_picture(
            fits_file(tmp_path / f"{name}.fits", cube, ROWORDER="TOP-DOWN")
        )
        tolerance = 0.51 if kind in ("u1", "u2") else 1e-3
        np.testing.assert_allclose(
            images.monochrome(picture.pixels), expected, rtol=0, atol=tolerance
        )


def test_a_cube_of_one_plane_is_an_image_and_one_of_many_is_refused(
    tmp_path: Path,
) -> None:
    path = fits_file(tmp_path / "one.fits", FRAME[None, None], ROWORDER="TOP-DOWN")
    np.testing.assert_array_equal(images.read_picture(path).pixels, FRAME)
    for shape in ((3, 2, 6, 9), (5,)):
        path = fits_file(
            tmp_path / f"{len(shape)}_{shape[0]}.fits", np.zeros(shape, np.int16)
        )
        message = re.escape(
            f"a FITS image of shape {shape}; allowed: (H, W), color (3, H, W) and (H, W, 3), or (N, H, W)"
        )
        assert re.search(message, complaint(path))


@pytest.mark.parametrize("kind", ["fits", "npy", "tif", "big.tif"])
def test_pages_are_read_one_by_one(kind: str, tmp_path: Path) -> None:
    """A thumbnail between the pages of a TIFF file is no page; a color page is one."""
    path = tmp_path / f"x.{kind}"
    pages = [FRAME + n for n in range(5)]
    if kind == "fits":
        fits_file(path, np.stack(pages), ROWORDER="BOTTOM-UP")
        pages = [page[::-1] for page in pages]
    elif kind == "npy":
        np.save(path, np.stack(pages).astype(">u2"))
    else:
        with tifffile.TiffWriter(path, bigtiff=kind != "tif") as file:
            for page in pages:
                file.write(page)
                file.write(page[::2, ::2], subfiletype=1)
    read = images.read_pictures(path)
    for page, found in zip(pages, read, strict=True):
        np.testing.assert_array_equal(found.pixels, page)
        assert found.pixels.dtype.isnative
    assert re.search(
        "a (TIFF|FITS or NPY) file of 5 images; allowed: a file", complaint(path)
    )


@pytest.mark.parametrize("maxval", [255, 4095, 65535])
@pytest.mark.parametrize("kind", ["P2", "P5"])
def test_pgm_is_read_as_written(kind: str, maxval: int, tmp_path: Path) -> None:
    image = RNG.integers(0, maxval + 1, (21, 30)).astype(np.uint8 if maxval < 256 else ">u2")
    text = " ".join([*map(str, image.ravel().tolist()), "\n"]).encode()
    body = text if kind == "P2" else image.tobytes()
    path = tmp_path / "x.pgm"
    path.write_bytes(f"{kind}\n# a comment\n30 21\n{maxval}\n".encode() + body)
    np.testing.assert_array_equal(images.read_picture(path).pixels, image)
    path.write_bytes(path.read_bytes()[:200])
    assert "cannot be decoded" in complaint(path)


@pytest.mark.parametrize("options", [{"lossless": True}, {"quality": 99}, {"exif": b""}])
def test_a_webp_is_read_and_its_size_known(options: dict[str, Any], tmp_path: Path) -> None:
    """The three ways in which the container states the size: VP8L, VP8 and VP8X."""
    path = tmp_path / "x.webp"
    if "exif" in options:
        exif = Image.Exif()
        exif[ORIENTATION] = 1
        options = {"exif": exif, "lossless": True}
    Image.fromarray(GRAY).save(path, **options)
    data = path.read_bytes()
    height, width = GRAY.shape
    assert list(encoded.webp_size(data)) == [((width, height), 4)]
    read = images.monochrome(images.read_picture(path).pixels)
    tolerance = 0 if "lossless" in options else 12
    assert np.abs(read.astype(int) - GRAY).max() <= tolerance


def test_npy_without_pictures_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    cases = {
        "pixels of type bool": np.zeros((5, 6), bool),
        "not a complete NPY file": np.array([{}]),
        "a NPY image of shape": np.zeros(5),
    }
    for message, array in cases.items():
        np.save(path, array, allow_pickle=True)
        assert message in complaint(path)
    np.save(path, FRAME)
    path.write_bytes(path.read_bytes()[:-8])
    assert "not a complete NPY file" in complaint(path)
    promise = b"{'descr': '|u1', 'fortran_order': False, 'shape': (99999, 99999)}"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(promise)) + promise)
    with path.open("r+b") as file:
        file.truncate(500 << 20)
    assert re.search("not a complete NPY file|pixels by its header", complaint(path))


# What a tracker gets


def light(pixels: NDArray, **more: Any) -> images.ViewedImage:
    return images.as_light(images.ViewedImage(pixels, **more))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.float32, np.float64])
def test_a_mosaic_becomes_the_luminance_at_every_pixel(kind: type) -> None:
    """Uniform light of three colors gives one level, (R + 2 G + B) / 4, whichever filter a pixel has."""
    raw = np.zeros((10, 13), kind)
    raw[0::2, 0::2], raw[1::2, 1::2] = 40, 120
    raw[0::2, 1::2] = raw[1::2, 0::2] = 100
    found = light(raw, mosaic="RGGB")
    np.testing.assert_array_equal(found.pixels, (40 + 2 * 100 + 120) / 4)
    assert "Bayer" in found.notes[0]
    assert light(raw).pixels is raw


def test_a_mosaic_is_known_by_its_header_or_tag(tmp_path: Path) -> None:
    path = fits_file(tmp_path / "x.fits", FRAME, ROWORDER="TOP-DOWN", BAYERPAT="GBRG")
    assert images.read_picture(path).mosaic == "GBRG"
    path = fits_file(tmp_path / "y.fits", FRAME, ROWORDER="TOP-DOWN", BAYERPAT="TRUE")
    assert images.read_picture(path).mosaic == ""
    for big in ("<", ">"):
        tags = [(33421, 3, 2, (2, 2)), (33422, 1, 4, bytes([0, 1, 1, 2]))]
        tifffile.imwrite(
            tmp_path / "x.tif", FRAME, photometric="cfa", extratags=tags, byteorder=big
        )
        picture = images.read_picture(tmp_path / "x.tif")
        np.testing.assert_array_equal(picture.pixels, FRAME)
        assert picture.mosaic == "TIFF"


def test_floats_up_to_one_get_the_noise_of_an_estimated_gain() -> None:
    """Whatever the scale and the level, the noise is NOISE_E; other floats stay as they are."""
    noise = RNG.normal(0, 1, (200, 200))
    for scale, level in ((1e-4, 0.1), (3e-3, 0.0), (0.05, -0.7)):
        found = light(level + scale * noise)
        assert np.std(found.pixels) == pytest.approx(images.NOISE_E, rel=0.03)
        assert "gain is estimated" in found.notes[0]
    assert light(np.zeros((4, 4))).scale == images.WHOLE_SCALE
    assert light(noise + 9).notes == ()


def test_masked_pixels_get_the_level_beside_them() -> None:
    """A sky whose level rises across the frame: no edge stands where the border begins."""
    sky = 1000 + np.arange(300.0) + RNG.normal(0, 3, (200, 300))
    masked = sky.copy()
    masked[:, 250:] = np.nan
    masked[:20] = np.nan
    found = light(masked)
    seen = ~np.isnan(masked)
    np.testing.assert_array_equal(found.pixels[seen], sky[seen])
    assert np.abs(found.pixels[50:, 250:] - 1250).max() < 12
    assert found.notes == ("15000 pixels without a number (NaN) are left out",)


RAWPY = """
import numpy as np
class imread:
    def __init__(self, path):
        self.raw_pattern = np.zeros((2, 2)) if b"bayer" in open(path, "rb").read() else None
        self.raw_image_visible = np.arange(12, dtype=np.uint16).reshape(3, 4)
    def __enter__(self):
        return self
    def __exit__(self, *_):
        pass
"""


@pytest.mark.slow
def test_camera_raw_needs_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for rawpy, which decodes in a child process."""
    path = tmp_path / "x.nef"
    path.write_bytes(b"bayer")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert complaint(path).endswith("allowed: pip install 'skysim[raw]'")
    monkeypatch.undo()
    (tmp_path / "rawpy.py").write_text(RAWPY)
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    picture = images.read_picture(path)
    np.testing.assert_array_equal(picture.pixels, np.arange(12).reshape(3, 4))
    assert picture.mosaic == "camera raw"
    path.write_bytes(b"x-trans")
    assert "its color filters are no Bayer mosaic" in complaint(path)


# What hostile files promise


def test_a_gzipped_file_is_unpacked_up_to_a_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gigabyte of zeros is a megabyte; what is beyond the limit is not unpacked."""
    monkeypatch.setattr(encoded, "MAX_BYTES", 100_000)
    monkeypatch.setattr(images, "GZIP_BLOCK", 10_000)
    whole = fits_file(tmp_path / "x.fits", FRAME).read_bytes()
    path = tmp_path / "x.fits.gz"
    path.write_bytes(gzip.compress(whole))
    images.read_picture(path)
    path.write_bytes(gzip.compress(whole + bytes(1_000_000)))
    assert "more than 100000 bytes when unpacked" in complaint(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_a_truncated_gzipped_file_is_refused_in_one_line(
    tmp_path: Path, share: float
) -> None:
    data = gzip.compress(
        fits_file(
            tmp_path / "x.fits", RNG.integers(0, 60_000, (60, 90), np.uint16)
        ).read_bytes()
    )
    path = tmp_path / "x.fits.gz"
    path.write_bytes(data[: int(share * len(data))])
    assert f"not a complete {'gzip' if share else 'FITS'} file" in complaint(path)


@pytest.mark.parametrize(
    "data", [b"once upon a time", gzip.compress(b"once upon a time", mtime=0), bytes(99)]
)
def test_an_invalid_gzipped_fits_file_is_refused_in_one_line(
    tmp_path: Path, data: bytes
) -> None:
    path = tmp_path / "x.fits.gz"
    path.write_bytes(data)
    assert re.search("not a complete (gzip|FITS) file", complaint(path))


def test_a_header_without_an_end_is_refused(tmp_path: Path) -> None:
    """Blanks, of which a gzipped file has as many as it likes; astropy joined them block by block for minutes."""
    path = tmp_path / "x.fits.gz"
    path.write_bytes(gzip.compress(b"SIMPLE  =" + b" " * 20_000_000))
    assert "a header of more than 100000 lines" in complaint(path)


def test_a_packed_file_s_pixels_are_counted_before_they_are_read(tmp_path: Path) -> None:
    header = b"".join(
        card.ljust(80)
        for card in (
            b"SIMPLE  = T",
            b"BITPIX  = 16",
            b"NAXIS   = 2",
            b"NAXIS1  = 99999",
            b"NAXIS2  = 99999",
        )
    )
    path = tmp_path / "x.fits.gz"
    path.write_bytes(gzip.compress((header + b"END".ljust(80)).ljust(2880) + bytes(2880)))
    assert re.search(
        "99999x99999 pixels by its header|not a complete FITS file", complaint(path)
    )


# TIFF


@pytest.mark.parametrize("planes", [True, False], ids=["planes", "pixels"])
@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
@pytest.mark.parametrize("packed", [None, "zlib"])
def test_color_planes_of_a_tiff_are_read_right_or_refused_by_name(
    tmp_path: Path, kind: str, planes: bool, packed: str | None
) -> None:
    """OpenCV reads planes of more than 8 bits as if they were interleaved, without a word."""
    rgb = RNG.uniform(0, 250, (30, 40, 3)).astype(kind)
    path = tmp_path / "x.tif"
    order = {"planarconfig": "separate" if planes else "contig", "compression": packed}
    tifffile.imwrite(
        path, np.moveaxis(rgb, 2, 0) if planes else rgb, photometric="rgb", **order
    )
    if planes and kind != "u1":
        bits = 8 * np.dtype(kind).itemsize
        assert (
            f"separate color planes (PlanarConfiguration 2) of {bits} bits; allowed: inter"
            in complaint(path)
        )
    else:
        np.testing.assert_array_equal(images.read_picture(path).pixels, rgb[:, :, ::-1])


def test_a_gray_tiff_is_read_with_any_planar_configuration(tmp_path: Path) -> None:
    Image.fromarray(FRAME).save(tmp_path / "x.tif")
    data = (tmp_path / "x.tif").read_bytes()
    entry = struct.pack("<HHIH", 284, 3, 1, 1)
    assert data.count(entry) == 1
    (tmp_path / "x.tif").write_bytes(data.replace(entry, struct.pack("<HHIH", 284, 3, 1, 2)))
    np.testing.assert_array_equal(images.read_picture(tmp_path / "x.tif").pixels, FRAME)


@pytest.mark.parametrize(
    ("photometric", "big"),
    [("minisblack", False), ("miniswhite", False), ("miniswhite", True)],
)
@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_a_tiff_whose_zero_is_white_is_refused(
    photometric: str, big: bool, kind: str, tmp_path: Path
) -> None:
    """OpenCV inverts some of them, without a word."""
    path = tmp_path / "x.tif"
    frame = (FRAME >> 8).astype(kind)
    tifffile.imwrite(path, frame, photometric=photometric, bigtiff=big)
    if photometric == "minisblack":
        np.testing.assert_array_equal(images.read_picture(path).pixels, frame)
    else:
        assert "0 is white (PhotometricInterpretation 0); allowed: 1" in complaint(path)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("second", "refused"), [(None, True), (1, False), (2, True)])
def test_a_tiff_of_several_images_is_refused(
    second: int | None, refused: bool, big: bool, tmp_path: Path
) -> None:
    """The second may be a thumbnail (NewSubfileType 1)."""
    path = tmp_path / "x.tif"
    with tifffile.TiffWriter(path, bigtiff=big) as file:
        file.write(FRAME)
        file.write(FRAME + 1, subfiletype=second)
    if refused:
        assert "a TIFF file of 2 images; allowed: a file for each" in complaint(path)
    else:
        np.testing.assert_array_equal(images.read_picture(path).pixels, FRAME)


def test_a_damaged_list_of_directories_ends(tmp_path: Path) -> None:
    """A directory that names itself as the next one, and one beyond the end of the file."""
    path = tmp_path / "x.tif"
    tifffile.imwrite(path, FRAME)
    data = path.read_bytes()
    tiff = encoded.Tiff(data)
    (at,) = tiff.directories()
    link = at + 2 + 12 * tiff.number("H", at)
    for target, message in ((at, "cannot be decoded"), (len(data) + 7, "")):
        path.write_bytes(data[:link] + struct.pack("<I", target) + data[link + 4 :])
        if message:
            assert message in complaint(path)
        else:
            np.testing.assert_array_equal(images.read_picture(path).pixels, FRAME)


def test_every_fits_file_of_skysim_has_its_row_order(tmp_path: Path) -> None:
    """Frames of a run have it by test_files; here those for trackers, and those that characterize a camera."""
    picture = SimpleNamespace(image_dn=FRAME, exposure_s=0.1, t_s=0.0, frame=0)
    tracker_interface.write_fits(tmp_path / "x.fits", picture)  # type: ignore[arg-type]
    camera = loader.load(
        "shefex2", {"camera.width_px": "16", "camera.height_px": "16"}
    ).camera
    for path in (tmp_path / "x.fits", next(frame_files.write_frames(camera, tmp_path, 1))):
        assert not images.read_picture(path).flipped
