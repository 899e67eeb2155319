"""Adversarial and malformed images for `skysim solve`, and what it may answer.

Each input is a file: noise, stripes, text, repeating lights, mirrored
skies, false headers, or bytes that are not an image. None may be solved, except images that contain (parts of) a true
sky, which may be solved with the attitude of any of these. No input may raise an exception, take more than 2 s of
processor time per megapixel (at least one megapixel is counted), or use more memory than ten decoded frames plus 64
MiB. For most inputs the camera or the field of view is given; one in 400 is searched over all focal lengths.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.camera import Camera
from skysim.apps import plate_solver
from skysim.apps.cli.terminal import progress
from skysim.core.images import IMAGE_SUFFIXES
from skysim.core.paths import CATALOGS, SCENES
from skysim.results.metrics import WRONG_RAD
from skysim.sources import stars as star_sources
from tests.helpers.drawn_frames import LIEBE_E, CameraSetup, paint, render
from tests.helpers.hostile_files import encoded, promise

LIMIT_S_PER_MPX = 2.0
MEMORY_FRAMES = 10
MEMORY_FLOOR = 64 << 20
CAMERA_FILE = SCENES / "shefex2.yaml"
FOV_DEG = 14.87
WIDTH = 659
HEIGHT = 493
SMALL = (240, 320)
LARGE = (4096, 4096)
USUAL = ((HEIGHT, WIDTH), SMALL, LARGE)
DEPTH = 4095
EIGHT_BIT = 0.2  # fraction of the 16-bit images that are reduced to 8 bits
SEARCHED = 1 / 400  # fraction solved with neither camera nor field of view
Rng = np.random.Generator
Skies = tuple[Rotation, ...]  # attitudes of the skies in an image


@dataclass(frozen=True)
class HostileInput:
    """An image or the bytes of a file, its suffix, and the attitudes that are correct solutions."""

    picture: NDArray | None
    suffix: str = ".png"
    data: bytes = b""
    skies: Skies = ()


@dataclass
class FamilyResult:
    """Results for the images of one family: counts, defects, worst time, and most memory in frames."""

    looked: int = 0
    right: int = 0
    defects: list[str] = field(default_factory=list)
    worst_s: float = 0.0
    most_frames: float = 0.0


# The families, each a function that makes an input from a random stream


def size(rng: Rng) -> tuple[int, int]:
    """Size of the camera's images, or a smaller one."""
    return (HEIGHT, WIDTH) if rng.uniform() < 0.5 else SMALL


def noise(rng: Rng) -> HostileInput:
    shape = size(rng)
    kind = rng.integers(5)
    if kind == 0:
        return HostileInput(rng.poisson(rng.uniform(1, 400), shape).astype(np.uint16))
    if kind == 1:
        return HostileInput(np.clip(rng.normal(300, 60, shape), 0, DEPTH).astype(np.uint16))
    if kind == 2:
        return HostileInput(rng.integers(0, DEPTH + 1, shape, dtype=np.uint16))
    if kind == 3:  # salt and pepper
        share = 10 ** rng.uniform(-5, -1)
        return HostileInput(
            np.where(rng.uniform(size=shape) < share, DEPTH, 100).astype(np.uint16)
        )
    clouds = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), rng.uniform(1, 20))
    return HostileInput(np.clip(500 + 2000 * clouds, 0, DEPTH).astype(np.uint16))


def stripes(rng: Rng) -> HostileInput:
    y, x = np.indices(size(rng))
    along = x * np.cos(turn := rng.uniform(0, np.pi)) + y * np.sin(turn)
    wave = np.sin(2 * np.pi * along / rng.uniform(2, 80))
    if rng.uniform() < 0.3:
        wave = wave * np.sin(2 * np.pi * (x - y) / rng.uniform(2, 80))
    if rng.uniform() < 0.4:
        wave = np.sign(wave)
    return HostileInput(speckled(1000 + rng.uniform(10, 900) * wave, rng))


def gradients(rng: Rng) -> HostileInput:
    y, x = np.indices(size(rng)) / WIDTH
    lamp = np.hypot(x - rng.uniform(), y - rng.uniform())
    slope = rng.uniform(-2000, 2000) * x + rng.uniform(-2000, 2000) * y
    return HostileInput(
        speckled(2000 + slope + 1500 * np.exp(-lamp / rng.uniform(0.01, 1)), rng)
    )


def text(rng: Rng) -> HostileInput:
    page = np.zeros(size(rng), np.uint8)
    for _ in range(rng.integers(1, 30)):
        word = "".join(map(chr, rng.integers(33, 127, rng.integers(1, 40))))
        at = tuple(int(one) for one in rng.integers(0, page.shape[::-1]))
        cv2.putText(
            page,
            word,
            at,
            int(rng.integers(8)),
            rng.uniform(0.2, 1.5),
            int(rng.integers(1, 256)),
            1,
        )
    return HostileInput(speckled(100 + 15.0 * page, rng))


def scattered(rng: Rng) -> HostileInput:
    """Lights at uniform random positions with fluxes of stars, from few to many."""
    count = int(rng.choice([3, 6, 12, 25, 60, 200]))
    return HostileInput(
        lit(rng.uniform(0, [WIDTH, HEIGHT], (count, 2)), star_light(count, rng), rng)
    )


def repeated(rng: Rng) -> HostileInput:
    """A few lights repeated on a lattice, as from LED panels or reflections in windows."""
    across, down = rng.uniform(30, 200, 2)
    cell = rng.uniform(0, [across, down], (rng.integers(1, 8), 2))
    steps = np.stack(np.meshgrid(np.arange(-1, 25), np.arange(-1, 20)), axis=-1).reshape(
        -1, 2
    )
    turn = rng.uniform(0, np.pi / 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    xy = (steps[:, None] * [across, down] + cell).reshape(-1, 2) @ (
        np.eye(2) if rng.uniform() < 0.5 else rotation
    )
    light = np.tile(star_light(len(cell), rng), len(steps))
    return HostileInput(lit(xy, light, rng))


def duplicated(rng: Rng) -> HostileInput:
    """Two superimposed skies: one sky doubled by a bumped lens, or two different ones. Either solution is correct."""
    one, attitude = starry(rng)
    if rng.uniform() < 0.5:
        shift = rng.integers(-40, 41, 2)
        moved = np.roll(one, shift, (0, 1))
        ground = np.median(one)
        # np.roll moves rows by shift[0] (y) and columns by shift[1] (x); near the boresight that is this rotation.
        shifted_attitude = (
            Rotation.from_rotvec(np.array([-shift[0], shift[1], 0]) / camera().focal_px)
            * attitude
        )
        return HostileInput(
            np.clip(one + (moved - ground), 0, DEPTH).astype(np.uint16),
            skies=(attitude, shifted_attitude),
        )
    other, other_attitude = starry(rng)
    return HostileInput(
        np.clip(one + other - np.median(one), 0, DEPTH).astype(np.uint16),
        skies=(attitude, other_attitude),
    )


def mirrored(rng: Rng) -> HostileInput:
    """A mirrored sky. No rotation of the sky equals its mirror image, with any lens."""
    lens = (
        camera()
        if rng.uniform() < 0.7
        else Camera.from_fov(WIDTH, HEIGHT, np.radians(rng.uniform(6, 60)))
    )
    picture = starry(rng, lens)[0]
    return HostileInput(
        np.ascontiguousarray(picture[:, ::-1] if rng.uniform() < 0.5 else picture[::-1])
    )


def kaleidoscope(rng: Rng) -> HostileInput:
    """Half of a sky and its mirror image; the true half may be solved."""
    picture, attitude = starry(rng)
    half = picture[:, : WIDTH // 2]
    return HostileInput(
        np.hstack([half, picture[:, WIDTH // 2 : WIDTH // 2 + 1], half[:, ::-1]]),
        skies=(attitude,),
    )


def shuffled(rng: Rng) -> HostileInput:
    """A true sky cut into squares that are permuted; the sky of a few squares may be solved."""
    picture, attitude = starry(rng)
    side = 82
    cells = [(r, c) for r in range(0, 6 * side, side) for c in range(0, 8 * side, side)]
    out = picture.copy()
    skies = []
    for (r, c), n in zip(cells, rng.permutation(len(cells)), strict=True):
        v, u = cells[n]
        out[r : r + side, c : c + side] = picture[v : v + side, u : u + side]
        skies.append(carried(np.array([(u, v), (c, r)]) + side / 2) * attitude)
    return HostileInput(out, skies=tuple(skies))


def carried(xy_px: NDArray) -> Rotation:
    """Rotation in camera axes that moves a small image patch from xy_px[0] to xy_px[1] and keeps it upright."""
    frames = []
    for ray in camera().rays(xy_px):
        x = np.array([ray[2], 0, -ray[0]]) / np.hypot(ray[0], ray[2])
        frames.append(np.stack([x, np.cross(ray, x), ray], axis=1))
    return Rotation.from_matrix(frames[1] @ frames[0].T)


def flat(rng: Rng) -> HostileInput:
    level = int(rng.choice([0, 1, 2000, DEPTH, 65535]))
    picture = np.full(size(rng), level, np.uint16)
    if rng.uniform() < 0.5:  # all equal but for a few pixels
        at = rng.integers(0, picture.shape, (rng.integers(1, 40), 2))
        picture[at[:, 0], at[:, 1]] = rng.integers(0, DEPTH)
    return HostileInput(picture)


def tiny(rng: Rng) -> HostileInput:
    shape = tuple(rng.choice([1, 2, 3, 15, 16, 17, 40, 400], 2))
    return HostileInput(
        rng.integers(0, DEPTH, shape, dtype=np.uint16), str(rng.choice([".png", ".tiff"]))
    )


def no_numbers(rng: Rng) -> HostileInput:
    """Floating-point images with values that are not finite, or extremely large or small."""
    picture = rng.normal(100, 10, size(rng)).astype(rng.choice(["f4", "f8"]))
    at = rng.integers(0, picture.size, rng.integers(1, 50))
    picture.ravel()[at] = rng.choice([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40], len(at))
    return HostileInput(picture, ".fits")


def broken(rng: Rng) -> HostileInput:
    """A valid file with some bytes changed, or truncated."""
    suffix = str(rng.choice([".png", ".tiff", ".jpg", ".bmp", ".fits"]))
    data = bytearray(encoded(rng.integers(0, 255, (64, 80), dtype=np.uint8), suffix))
    for _ in range(rng.integers(1, 20)):
        data[int(rng.integers(0, min(len(data), 3000)))] = int(rng.integers(256))
    cut = int(rng.integers(0, len(data))) if rng.uniform() < 0.3 else len(data)
    return HostileInput(None, suffix, bytes(data[:cut]))


def rubbish(rng: Rng) -> HostileInput:
    suffix = str(rng.choice(IMAGE_SUFFIXES))
    heads = (
        b"",
        b"\x89PNG\r\n\x1a\n",
        b"\xff\xd8\xff",
        b"BM",
        b"II*\0",
        b"MM\0*",
        b"SIMPLE  = ",
    )
    return HostileInput(
        None, suffix, heads[rng.integers(len(heads))] + rng.bytes(int(rng.integers(0, 5000)))
    )


def promises(rng: Rng) -> HostileInput:
    """The header of a very large image with truncated data."""
    side = int(rng.choice([20_000, 60_000, 2**30]))
    suffix = str(rng.choice([".png", ".bmp", ".tiff", ".jpg", ".fits"]))
    return HostileInput(
        None, suffix, promise(suffix, side, side) + rng.bytes(int(rng.integers(0, 3000)))
    )


def large(rng: Rng) -> HostileInput:
    """Sixteen megapixels of noise with lights, or of a lattice of up to four million lights in eight bits."""
    if rng.uniform() < 0.4:
        picture = np.full(LARGE, 10, np.uint8)
        picture[:: rng.integers(2, 9), :: rng.integers(2, 9)] = rng.integers(60, 256)
        return HostileInput(picture, ".tiff")
    picture = rng.integers(90, 110, LARGE, dtype=np.uint16)
    at = rng.integers(8, 4088, (rng.integers(0, 500), 2))
    for dy, dx, share in [(0, 0, 1.0), (0, 1, 0.6), (1, 0, 0.6), (1, 1, 0.4)]:
        picture[at[:, 0] + dy, at[:, 1] + dx] = int(2000 * share)
    return HostileInput(picture, ".tiff")


Family = Callable[[Rng], HostileInput]
# Relative frequency of each family.
FAMILIES: dict[Family, float] = {
    **dict.fromkeys((noise, stripes, gradients, text, scattered, repeated), 10),
    **dict.fromkeys((duplicated, kaleidoscope, shuffled), 4),
    mirrored: 12,
    **dict.fromkeys((flat, tiny, no_numbers, broken, rubbish, promises), 4),
    large: 0.05,
}


# Parts of the inputs


@lru_cache
def camera() -> Camera:
    return plate_solver.make_solver(None, CAMERA_FILE).candidate_cameras(WIDTH, HEIGHT)[0][0]


@lru_cache
def stars() -> catalog.StarCatalog:
    """Catalog stars without aberration, because the solvers do not apply it to images without a date."""
    return catalog.brighter_than(catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv"), 7.0)


def starry(rng: Rng, lens: Camera | None = None) -> tuple[NDArray, Rotation]:
    """An image of a true sky, and its attitude."""
    return render(
        CameraSetup("", lens or camera(), LIEBE_E, 7.0, 60, 15, 16, DEPTH), stars(), rng
    )


def star_light(count: int, rng: Rng) -> NDArray:
    """Fluxes in digital numbers, drawn from those of the catalog's stars."""
    return LIEBE_E / 16 * 10 ** (-0.4 * rng.choice(stars().v_mag[:4000], count))


def lit(xy_px: NDArray, light_dn: NDArray, rng: Rng) -> NDArray:
    """An image of Gaussian lights on a uniform background, with noise."""
    picture = np.full((HEIGHT, WIDTH), 20.0)
    inside = np.all((xy_px > 0) & (xy_px < [WIDTH, HEIGHT]), axis=1)
    paint(picture, xy_px[inside], light_dn[inside], np.zeros((int(inside.sum()), 2)), 0.7)
    return speckled(picture, rng)


def speckled(picture: NDArray, rng: Rng) -> NDArray:
    return np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, DEPTH).astype(np.uint16)


# Solving and checking the inputs


@dataclass
class Judge:
    """Cached solvers, and a folder for the files."""

    folder: Path
    solvers: dict[str, dict[tuple[int, ...], plate_solver.Solver]] = field(
        default_factory=dict
    )

    def solver(self, prior: str, shape: tuple[int, ...]) -> plate_solver.Solver:
        """A cached solver for each usual size, because its trackers take seconds to build, and one for other sizes.

        prior : information given to the solver: "camera", "field" (of view) or "nothing"
        """
        shape = shape if shape in USUAL else ()
        how = {
            "camera": (None, CAMERA_FILE),
            "field": (FOV_DEG, None),
            "nothing": (None, None),
        }[prior]
        cached = self.solvers.setdefault(prior, {})
        if shape not in cached:
            cached[shape] = plate_solver.make_solver(*how)
            if shape:
                list(cached[shape].trackers(*shape[::-1]))
        return cached[shape]

    def take(self, n: int, seed: int) -> tuple[str, HostileInput, dict, float, float]:
        """Make and solve input number n: family, input, answer, processor seconds, bytes of memory above the floor."""
        rng = np.random.default_rng([seed, n])
        weight = np.array(list(FAMILIES.values()))
        family = list(FAMILIES)[rng.choice(len(FAMILIES), p=weight / weight.sum())]
        case = family(rng)
        if (
            case.picture is not None
            and case.picture.dtype == np.uint16
            and rng.uniform() < EIGHT_BIT
        ):
            case = replace(case, picture=(case.picture >> 4).clip(0, 255).astype(np.uint8))
        fits_camera = case.picture is not None and case.picture.shape == (HEIGHT, WIDTH)
        prior = "camera" if fits_camera and rng.uniform() < 0.8 else "field"
        prior = "nothing" if rng.uniform() < SEARCHED else prior
        path = self.folder / f"{family.__name__}{case.suffix}"
        path.write_bytes(
            case.data if case.picture is None else encoded(case.picture, case.suffix)
        )
        solver = self.solver(prior, case.picture.shape if case.picture is not None else ())
        answer, seconds, memory_bytes = timed(path, solver)
        # Solve again, because compilation may have caused the defect.
        if any(defects(case, answer | {"prior": prior}, seconds, memory_bytes)):
            answer, seconds, memory_bytes = timed(path, solver)
        return family.__name__, case, answer | {"prior": prior}, seconds, memory_bytes


def timed(path: Path, solver: plate_solver.Solver) -> tuple[dict, float, float]:
    """Solve a file: answer, processor seconds, and peak memory above MEMORY_FLOOR in bytes."""
    before = memory("VmRSS", reset=True)
    begin = time.process_time()
    try:
        answer = plate_solver.solve_file(path, solver)
    except Exception as error:  # any exception is a defect
        answer = {"status": f"raised {error!r}", "raised": True}
    seconds = time.process_time() - begin
    return answer, seconds, max(memory("VmHWM") - before - MEMORY_FLOOR, 0)


def memory(key: str, reset: bool = False) -> int:
    """Current memory in bytes (VmRSS), or the peak since the last reset (VmHWM); 0 on systems other than Linux."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(key))


def wrong(answer: dict, skies: Skies) -> bool:
    """Whether the solution is wrong: it displaces the image corners by more than ten arcminutes for all true skies."""
    if answer.get("ra_deg") is None:
        return False
    cam_from_icrs = star_sources.cam_from_icrs(
        answer["ra_deg"], answer["dec_deg"], answer["roll_deg"]
    )
    corners = camera().rays(camera().corners_px + 0.5)
    error_rad = (
        np.linalg.norm((cam_from_icrs * sky.inv()).apply(corners) - corners, axis=1).max()
        for sky in skies
    )
    return all(error > WRONG_RAD for error in error_rad)


def judged(count: int, seed: int, quiet: bool = True) -> dict[str, FamilyResult]:
    """Results for `count` inputs, by family."""
    results: dict[str, FamilyResult] = {}
    with tempfile.TemporaryDirectory() as folder:
        judge = Judge(Path(folder))
        for n in progress(range(count), count, "hostile pictures", quiet):
            try:
                name, case, answer, seconds, memory_bytes = judge.take(n, seed)
            except KeyboardInterrupt:  # report the results so far
                break
            result = results.setdefault(name, FamilyResult())
            result.looked += 1
            result.defects += (
                f"{n}: {one}" for one in defects(case, answer, seconds, memory_bytes)
            )
            result.right += answer.get("ra_deg") is not None
            result.worst_s = max(result.worst_s, seconds)
            if case.picture is not None:
                result.most_frames = max(
                    result.most_frames, memory_bytes / case.picture.nbytes
                )
    return results


def defects(
    case: HostileInput, answer: dict, seconds: float, memory_bytes: float
) -> Iterator[str]:
    """Yield a description of each violated requirement."""
    pixels, held = (
        (case.picture.size, case.picture.nbytes) if case.picture is not None else (0, 0)
    )
    if answer.get("raised"):
        yield answer["status"]
    if "\n" in answer["status"]:
        yield f"more than a line: {answer['status']!r}"
    if wrong(answer, case.skies):
        yield f"WRONG ATTITUDE {answer}"
    if seconds > LIMIT_S_PER_MPX * max(pixels / 1e6, 1):
        yield f"SLOW {seconds:.1f} s, prior {answer['prior']}"
    if memory_bytes > MEMORY_FRAMES * held:
        yield f"MEMORY {memory_bytes / 2**20:.0f} MiB beyond the first {MEMORY_FLOOR >> 20}"
