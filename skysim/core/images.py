"""Image files (FITS, those of `encoded`, NPY, camera raw) and frames of a live camera, read with limits on their size.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. The declared size is therefore
read from the header, and checked, before astropy (`fits`) or OpenCV (`encoded`) decodes the file.

1. `read_pictures` reads the pictures of a file as they are stored; `read_picture` the only one.
2. `as_light` makes a picture that a tracker takes: monochrome, without a mosaic of filters, in digital numbers.
"""

import datetime
import gzip
import importlib.util
import math
import os
import re
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import IO, Any, BinaryIO

import cv2
import numpy as np

from skysim.core import encoded
from skysim.core.constants import SIGMA_PER_MAD
from skysim.core.encoded import check_pixels, silent_stderr
from skysim.core.errors import InputError, reason, refusing
from skysim.core.files import strict_warnings
from skysim.core.guarded import run_guarded
from skysim.core.text import LARGEST
from skysim.core.types import Array, Record, frozen
from skysim.core.yaml_reader import check_bytes

# FITS images: plain, gzipped (.gz) or compressed in tiles (.fz), monochrome or color, with their
# row order and date.


SUFFIXES = tuple(
    f"{suffix}{packed}"
    for packed in ("", ".gz", ".fz")
    for suffix in (".fits", ".fit", ".fts")
)
MAGIC = b"SIMPLE  ="  # start of every FITS file; a compressed one differs, which astropy would unpack
GZIP_BLOCK = 1 << 20  # bytes unpacked at a time
MAX_HDUS = 1000  # that are searched for an image
# a line of a header, and their greatest number
CARD_BYTES = 80
MAX_CARDS = 100_000
# FITS standard 4.0, section 4.4.1.1
AXES = re.compile(rb"NAXIS *= *(\d+)")
MAX_AXES = 999
MAX_COLUMNS = 999  # of a table (FITS standard 4.0, section 7.3.1)
# for a compressed image, or camera raw
TILES_CPU_S = 10
TILES_BYTES = 1 << 31
EXPOSURE_KEYS = ("EXPTIME", "EXPOSURE")  # seconds
# Of the chip, degrees Celsius: conventions of imaging programs.
TEMPERATURE_KEYS = ("CCD-TEMP", "DET-TEMP")
# Color filters of the first 2 x 2 pixels, such as RGGB: conventions of imaging programs.
MOSAIC_KEYS = ("BAYERPAT", "COLORTYP")
# Values of ROWORDER, which is a convention of imaging programs.
TOP_DOWN = {"TOP-DOWN": True, "BOTTOM-UP": False}
TOP_DOWN_CARD = ("ROWORDER", "TOP-DOWN", "the first row is the highest")
ASSUMED_TOP_DOWN = "no ROWORDER in the header: its first row is the highest here, not the lowest as by the standard"

# Messages of FFmpeg about a damaged film; OpenCV reads this at its first film.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def read_fits_images(path: Path) -> list["ViewedImage"]:
    """The first image of a FITS file, or the planes of a cube, in the machine's byte order. Raises InputError."""
    from astropy.io import fits

    try:
        with (
            open_fits(path) as file,
            fits.open(file, memmap=False, disable_image_compression=True) as hdus,
        ):
            for number, hdu in enumerate(islice(hdus, MAX_HDUS)):
                check_hdu(path, hdu)
                if hdu.header.get("ZIMAGE"):
                    pixels = decode_guarded(
                        path, "a complete FITS file", file.name, str(number)
                    )
                elif getattr(hdu, "is_image", False) and hdu.header.get("NAXIS", 0) > 0:
                    pixels = np.ascontiguousarray(
                        hdu.data.astype(hdu.data.dtype.newbyteorder("="))
                    )
                else:
                    place = hdu.fileinfo()
                    # The next one, before it is opened.
                    check_header(path, file, place["datLoc"] + place["datSpan"])
                    continue
                values = header_values(hdu.header, hdus[0].header)
                step = -1 if values["flipped"] else 1
                return [
                    ViewedImage(np.ascontiguousarray(page[::step]), **values)
                    for page in planes(path, pixels)
                ]
    except InputError:
        raise
    except (OSError, UserWarning) as error:
        raise InputError(path, f"not a complete FITS file: {reason(error)}") from None
    except Exception:
        # A damaged header makes astropy raise many types, with words for its authors.
        raise InputError(path, "not a complete FITS file") from None
    raise InputError(path, "a FITS file without an image")


@contextmanager
def open_fits(path: Path) -> Iterator[BinaryIO]:
    """The file for astropy, with its warnings as errors: past a warning it may read a damaged file endlessly.

    A .gz file is unpacked to a temporary file first.
    """
    packed = path.suffix.lower() == ".gz"
    with ExitStack() as stack:
        plain = path
        if packed:
            temporary = stack.enter_context(tempfile.NamedTemporaryFile(prefix="skysim-"))
            unpack(path, temporary)
            plain = Path(temporary.name)
        file = stack.enter_context(plain.open("rb"))
        # "File may have been truncated" is one.
        stack.enter_context(strict_warnings())
        if file.read(len(MAGIC)) != MAGIC:
            allowed = "one that begins with SIMPLE" + ("" if packed else ", not compressed")
            raise InputError(path, "not a complete FITS file", allowed)
        file.seek(0)
        check_header(path, file)
        yield file


def unpack(path: Path, file: IO[bytes]) -> None:
    """Unpack a gzipped file, up to MAX_BYTES. Raises InputError for more, and for a damaged file."""
    size = 0
    damaged = (gzip.BadGzipFile, EOFError, zlib.error)
    with refusing(damaged, path, "not a complete gzip file"), gzip.open(path) as packed:
        while block := packed.read(GZIP_BLOCK):
            size += len(block)
            if size > encoded.MAX_BYTES:
                raise InputError(
                    path, f"more than {encoded.MAX_BYTES} bytes when unpacked", "no more"
                )
            file.write(block)
    file.flush()


def check_header(path: Path, file: BinaryIO, start: int = 0) -> None:
    """Refuse the header that begins at `start` if it is longer than any real one, or has too many axes.

    astropy makes a list of as many entries as NAXIS says when it opens a header, and joins all blocks up to END.
    Raises InputError; the file is left where it was.
    """
    before = file.tell()
    file.seek(start)
    for _ in range(MAX_CARDS):
        card = file.read(CARD_BYTES)
        if not card or card.rstrip() == b"END":
            break
        if (hit := AXES.match(card)) and int(hit[1]) > MAX_AXES:
            raise InputError(path, f"NAXIS {int(hit[1])}", f"up to {MAX_AXES} axes")
    else:
        raise InputError(
            path, f"a header of more than {MAX_CARDS} lines", f"up to {MAX_CARDS}"
        )
    file.seek(before)


def check_hdu(path: Path, hdu: Any) -> None:
    """Raise InputError for too large a size by the header, before the data is read or skipped."""
    if (columns := hdu.header.get("TFIELDS", 0)) > MAX_COLUMNS:
        raise InputError(path, f"TFIELDS {columns}", f"up to {MAX_COLUMNS} columns")
    if hdu.header.get("ZIMAGE"):
        sides = (int(hdu.header[f"ZNAXIS{n}"]) for n in range(hdu.header["ZNAXIS"], 0, -1))
        check_pixels(path, *sides, each_bytes=abs(int(hdu.header.get("ZBITPIX", 8))) // 8)
        return
    item_bytes = abs(int(hdu.header.get("BITPIX", 8))) // 8
    check_pixels(path, *map(int, getattr(hdu, "shape", ()) or ()), each_bytes=item_bytes)
    check_pixels(path, int(hdu.size) // 8)


def decode_guarded(path: Path, what: str, *arguments: str) -> Array:
    """The pixels that the script `fits_tiles` decodes in a child process. Raises InputError with one line."""
    with tempfile.TemporaryDirectory(prefix="skysim-") as folder:
        out = Path(folder) / "pixels.npy"
        script = Path(__file__).with_name("fits_tiles.py")
        if fault := run_guarded(
            script, *arguments, str(out), cpu_s=TILES_CPU_S, memory_bytes=TILES_BYTES
        ):
            raise InputError(path, f"not {what}: {fault}")
        return np.load(out)


def planes(path: Path, pixels: Array) -> list[Array]:
    """The images of an array: (H, W), a color image (3, H, W) or (H, W, 3), red first, as (H, W, 3), blue first, or N.

    Raises
    ------
    InputError
        For any other shape.
    """
    shape = pixels.shape
    while pixels.ndim > 2 and pixels.shape[0] == 1:
        pixels = pixels[0]
    if pixels.ndim == 3 and pixels.shape[0] == 3:
        pixels = np.moveaxis(pixels, 0, 2)
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        return [np.ascontiguousarray(pixels[:, :, ::-1])]
    if pixels.ndim == 3 and min(pixels.shape) > 0:
        return list(pixels)
    if pixels.ndim != 2:
        kind = "NPY" if path.suffix.lower() == NPY else "FITS"
        raise InputError(
            path,
            f"a {kind} image of shape {shape}",
            "(H, W), color (3, H, W) and (H, W, 3), or (N, H, W)",
        )
    return [pixels]


def header_values(*headers: Any) -> Record:
    """ViewedImage's fields other than the pixels, by the first header that has them: the image's, then the file's."""
    found = {}
    for header in reversed(headers):
        for key in ("ROWORDER", "DATE-OBS", *MOSAIC_KEYS, *EXPOSURE_KEYS, *TEMPERATURE_KEYS):
            with suppress(Exception):  # of many types, for a damaged card
                found[key] = str(header[key]).strip()
    date_utc = None
    with suppress(ValueError):
        date_utc = datetime.datetime.fromisoformat(found.get("DATE-OBS", ""))
    top_down = TOP_DOWN.get(found.get("ROWORDER", "").upper())
    filters = [found[key].upper() for key in MOSAIC_KEYS if key in found]
    return {
        "mosaic": next((one for one in filters if sorted(one) == ["B", "G", "G", "R"]), ""),
        "date_utc": date_utc,
        "row_order_known": top_down is not None,
        "exposure_s": first_number(found, EXPOSURE_KEYS),
        "temperature_c": first_number(found, TEMPERATURE_KEYS),
        "flipped": not top_down,
    }


def first_number(found: dict[str, str], keys: tuple[str, ...]) -> float | None:
    """The first finite number under these keys."""
    for key in keys:
        with suppress(ValueError):
            if math.isfinite(number := float(found.get(key, ""))):
                return number
    return None


NPY = ".npy"
CAMERA_RAW = (".dng", ".cr2", ".nef", ".arw")  # of digital cameras with a Bayer mosaic
IMAGE_SUFFIXES = (*SUFFIXES, *encoded.SUFFIXES, NPY, *CAMERA_RAW)
NOISE_E = 10.0  # assumed noise of a pixel, of read-out and sky, in frames of unknown scale
WHOLE_SCALE = 65535.0  # of frames without noise
LUMINANCE = np.array(
    [0.114, 0.587, 0.299]
)  # of blue, green and red (ITU-R BT.601), OpenCV's order


@frozen
class ViewedImage:
    """An image as a person sees it: turned as EXIF says, the highest row first.

    Attributes
    ----------
    pixels
        (H, W) or (H, W, channels), blue first
    date_utc
        DATE-OBS of a FITS file; None without a valid one
    focal_35mm
        Focal length of the 35 mm camera with the same diagonal field, mm; None if unknown
    flipped
        Whether the file's first row is the lowest one here
    mosaic
        What says that the pixels have color filters, in Bayer's mosaic: RGGB of a header, or the file's kind; or empty
    scale
        Digital numbers per unit of the file, by which `as_light` multiplied the pixels
    notes
        What `as_light` changed, for the answer
    row_order_known
        False for a FITS file without ROWORDER, whose last row is then taken for the highest, as
        the standard recommends; but programs that do not follow it leave the keyword out too
    exposure_s, temperature_c
        EXPTIME or EXPOSURE, CCD-TEMP or DET-TEMP of a FITS header; None without a number
    """

    pixels: Array
    date_utc: datetime.datetime | None = None
    focal_35mm: float | None = None
    row_order_known: bool = True
    exposure_s: float | None = None
    temperature_c: float | None = None
    flipped: bool = False
    mosaic: str = ""
    scale: float = 1.0
    notes: tuple[str, ...] = ()


def read_picture(path: Path) -> ViewedImage:
    """The image of a file as a person sees it.

    Raises
    ------
    InputError
        With one line for a file that is missing, truncated, not an image, has too many pixels, or several images.
    """
    pages = read_pictures(path)
    if len(pages) > 1:
        kind = "TIFF" if path.suffix.lower() in (".tif", ".tiff") else "FITS or NPY"
        raise InputError(path, f"a {kind} file of {len(pages)} images", "a file for each")
    return pages[0]


def read_pictures(path: Path) -> list[ViewedImage]:
    """The images of a file as a person sees them, as `read_picture`."""
    check_name(path)
    suffix = image_suffix(path.name)
    if suffix in SUFFIXES:
        pages = read_fits_images(path)
    elif suffix == NPY:
        pages = [ViewedImage(page) for page in planes(path, read_npy(path))]
    else:
        data = path.read_bytes()
        if suffix in CAMERA_RAW:
            found, mosaic = [read_camera_raw(path)], "camera raw"
            exif = encoded.read_exif_block(data)
        else:
            found, is_mosaic = encoded.decode_images(path, data)
            mosaic = "TIFF" * is_mosaic
            exif = encoded.read_exif(data)
        pages = [
            ViewedImage(
                encoded.upright(pixels, exif.orientation),
                focal_35mm=exif.focal_35mm,
                mosaic=mosaic,
            )
            for pixels in found
        ]
    for page in pages:
        if page.pixels.dtype.kind not in "uif":
            raise InputError(
                path, f"pixels of type {page.pixels.dtype}", "integers and floats"
            )
        if page.pixels.dtype.kind == "f":
            finite = page.pixels[np.isfinite(page.pixels)]
            largest = max(finite.max(initial=0), -finite.min(initial=0))
            if largest > LARGEST:
                raise InputError(path, f"pixels up to {largest:.3g}", f"up to {LARGEST:g}")
    return pages


def read_npy(path: Path) -> Array:
    """The array of an NPY file, mapped until its size is checked, since it may declare any. Raises InputError."""
    # A damaged header gives errors of many types.
    with refusing(Exception, path, "not a complete NPY file"):
        stored = np.lib.format.open_memmap(path, mode="r")
    check_pixels(path, *stored.shape, each_bytes=stored.itemsize)
    kind = stored.dtype.newbyteorder("=")
    # Half precision ends at 65504.
    return np.array(stored, np.float32 if kind == np.float16 else kind, order="C")


def read_camera_raw(path: Path) -> Array:
    """The pixels of a digital camera's raw file, each with its color filter. Raises InputError, also without rawpy."""
    if importlib.util.find_spec("rawpy") is None:
        raise InputError(
            path, "camera raw needs an optional package", "pip install 'skysim[raw]'"
        )
    return decode_guarded(path, "a complete camera raw file", str(path), "raw")


def as_light(picture: ViewedImage) -> ViewedImage:
    """The picture as a tracker takes it: monochrome, in digital numbers, with what was changed in `notes`.

    1. Colors become luminance.
    2. A pixel without a number (NaN: a border, a mask) gets the level of the nearest pixels that have one.
    3. In a mosaic the binomial filter [1 2 1] x [1 2 1] / 16 gives (R + 2 G + B) / 4 at every pixel, whichever filter
       the pixel has: the weights of each color add up to the same in all four positions.
    4. Floats that do not exceed 1 are no digital numbers. They are scaled so that the noise of the background is
       NOISE_E: a digital number then is about an electron, which is assumed of unknown cameras. The noise follows from
       the median difference of neighbors, in which few pixels have stars.
    """
    pixels = monochrome(picture.pixels)
    notes = []
    # 2. Masked pixels.
    is_float = pixels.dtype.kind == "f"
    if is_float and (masked := np.isnan(pixels)).any() and not masked.all():
        from scipy import ndimage

        nearest = tuple(ndimage.distance_transform_edt(masked, return_indices=True)[1])
        filled = pixels[nearest]
        level = cv2.medianBlur(filled.astype(np.float32), 5)[nearest]
        pixels = np.where(masked, level, filled)
        notes.append(f"{masked.sum()} pixels without a number (NaN) are left out")
    # 3. Mosaic.
    if picture.mosaic and picture.pixels.ndim == 2:
        raw = pixels if pixels.dtype.itemsize < 4 else pixels.astype(np.float64)
        pixels = cv2.GaussianBlur(raw, (3, 3), 0)
        notes.append(f"a raw Bayer frame ({picture.mosaic}): its luminance over 3x3 pixels")
    # 4. Scale.
    scale = 1.0
    if is_float and pixels.size and pixels.max() <= 1:
        change = np.abs(np.diff(pixels.astype(np.float64)))
        noise = np.median(change) * SIGMA_PER_MAD / math.sqrt(2) if change.size else 0.0
        scale = float(NOISE_E / noise) if noise > 1 / LARGEST else WHOLE_SCALE
        pixels = pixels * scale
        notes.append(
            f"floats up to 1, scaled by {scale:.4g}: the gain is estimated, {NOISE_E:g} e- of noise are assumed"
        )
    return replace(picture, pixels=pixels, scale=scale, notes=tuple(notes))


def read_image(path: Path) -> Array:
    """The pixels of `read_ordered`."""
    return read_ordered(path).pixels


def read_ordered(path: Path) -> ViewedImage:
    """`read_picture` for callers that cannot try both row orders: a FITS file must have ROWORDER."""
    picture = read_picture(path)
    if not picture.row_order_known and not np.array_equal(
        picture.pixels, picture.pixels[::-1]
    ):
        raise InputError(
            path,
            "no ROWORDER in the header",
            f"{' or '.join(TOP_DOWN)}, or a PNG or TIFF file",
        )
    return picture


def image_suffix(name: str) -> str:
    """The suffix of an image file's name, in small letters: the longest known one; empty if there is none."""
    return max(
        (suffix for suffix in IMAGE_SUFFIXES if name.lower().endswith(suffix)),
        key=len,
        default="",
    )


def stem_of(path: Path) -> str:
    """The file's name without the suffix of its image format; of another file, without its suffix."""
    suffix = image_suffix(path.name)
    return path.name[: -len(suffix)] if suffix else path.stem


def best_images(
    folder: Path, rank: Callable[[Path], int], recursive: bool = False
) -> dict[Path, Path]:
    """The images of a folder by their path without suffix; of several formats, that of the least rank.

    Raises
    ------
    InputError
        If there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder of images")
    best: dict[Path, Path] = {}
    for path in sorted(folder.rglob("*") if recursive else folder.iterdir()):
        if image_suffix(path.name) and not path.name.startswith("."):
            stem = path.with_name(stem_of(path))
            best[stem] = min(best.get(stem, path), path, key=rank)
    return best


def check_size(path: Path, pixels: Array, shape: tuple[int, int]) -> None:
    """Raise InputError unless an image has the (height, width) of its camera."""
    if pixels.shape != shape:
        raise InputError(
            path,
            f"{pixels.shape[1]} x {pixels.shape[0]} pixels",
            f"{shape[1]} x {shape[0]}, as the camera has them",
        )


def check_name(path: Path) -> None:
    """Raise InputError for a missing or too large file, and for one with the suffix of no known format."""
    if not path.is_file():
        raise InputError(path, "no such file")
    if not image_suffix(path.name):
        raise InputError(path, "unknown image suffix", ", ".join(IMAGE_SUFFIXES))
    check_bytes(path, encoded.MAX_BYTES)


def is_fits(path: Path) -> bool:
    """Whether this is the name of a FITS file."""
    return path.name.lower().endswith(SUFFIXES)


def monochrome(image: Array) -> Array:
    """Luminance of a color image (alpha is ignored); a monochrome one unchanged. Raises InputError."""
    if image.ndim == 2:
        return image
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise InputError(
            "",
            f"an image of shape {image.shape}",
            "(height, width) and color with 3 or 4 channels",
        )
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    if image.dtype in (np.uint8, np.uint16, np.float32):
        return cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
    return image[:, :, :3] @ LUMINANCE


LIVE_SOURCES = "an index such as 0, a video file, a URL, gige://HOST"


class LiveCamera:
    """An open camera or video stream, read frame by frame."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.frame_count = 0
        if Path(source).is_fifo():
            raise InputError(source, "a pipe, which may never begin", LIVE_SOURCES)
        with silent_stderr():
            self.capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
            self.capture.set(
                cv2.CAP_PROP_BUFFERSIZE, 1
            )  # the newest frame, not a buffered one

    def frame(self) -> Array:
        """The next frame, (H, W) or (H, W, 3). Raises InputError if there is none."""
        with silent_stderr():
            ok, frame = self.capture.read()
        if not ok or frame is None:
            if self.frame_count:
                raise InputError(self.source, f"ends after {self.frame_count} frames")
            raise InputError(self.source, "no camera found", LIVE_SOURCES)
        self.frame_count += 1
        return frame

    def close(self) -> None:
        """Release the camera."""
        self.capture.release()


def video_numbers(path: Path) -> tuple[float, int]:
    """Frame rate in Hz and number of frames of a video, by its container. Raises InputError if it cannot be read."""
    with closing(LiveCamera(str(path))) as video:
        rate_hz = video.capture.get(cv2.CAP_PROP_FPS)
        count = int(video.capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if not (rate_hz > 0 and count > 0):
        raise InputError(path, "not a video that can be read", "AVI, MP4, MOV, MKV")
    return rate_hz, count
