"""Integrate the sources' images over an exposure to mean photo-electrons per pixel.

The smear integral: a source n gives the pixel (i, j) the mean number of electrons

    E_ij = integral over the exposure of rate_n(t) on_n(t) K_n(i - x_n(t), j - y_n(t)) dt,

with its rate, the pulses on_n (0 or 1), its pixel-integrated image K_n (unit sum) and the moving position (x_n, y_n)
of that image. Smear by body rate, jitter, pulsed LEDs and rolling shutters are all part of this integral.

1. `in_view` (projection.py) keeps the sources that come near the field at any time of the exposure.
2. `image_tracks` projects them at K even times: positions in pixels and rates. Between the times they are interpolated
   by cubics.
3. `source_kernels` (psf/kernel_cache.py) gives each source its image K_n and the size of that image's sharpest feature.
4. `draw` integrates each source on a patch of its own (`_integrate`): the exposure is cut into pieces in which the
   image moves by less than STEP times that feature, and each piece is replaced by two points of light (a two-point
   Gauss rule for steady light), added by psf/splat.py or psf/ellipse.py.
5. The patches are added to the frame.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from skysim.camera.optics import Optics
from skysim.camera.projection import (
    Poses,
    Tracks,
    image_tracks,
    in_view,
    poses,
    sample_times,
)
from skysim.camera.psf.ellipse import EllipseDisk, add_ellipse, ellipse_table, sharpest_px
from skysim.camera.psf.kernel import ELLIPSE, GAUSS, ROUND, DiskImages, disk_images
from skysim.camera.psf.kernel_cache import Kernels, source_kernels
from skysim.camera.psf.splat import add_gaussian, add_grid, add_round
from skysim.core.jit import jit
from skysim.core.types import (
    Bools,
    Floats,
    Ints,
    Mount,
    Singles,
    Sources,
    SourceTruth,
    Trajectory,
    taken,
)
from skysim.sources.dome.led import Emitter, lit_moments_s

# Largest motion in one piece of the exposure, in units of the image's sharpest feature (sigma).
STEP = 1.3
MAX_PIECES = 100_000
# Path length, in steps, up to which one piece is enough: error 1e-4 of the peak.
SINGLE_PIECE_STEPS = 0.4
DISK_FIELDS = len(EllipseDisk._fields)
# An image that moves less is drawn as one point.
STILL_PX = 1e-3
# Pixels of patches held in memory at once, or as many as the frame has.
MAX_PATCH_PIXELS = 1 << 20

# (N,) which of N sources at `Sources.place` are occluded
OcclusionTest = Callable[[Floats], Bools]


class Window(NamedTuple):
    """Exposure interval: the first of some rows from open_s for exposure_s, each next row row_time_s later."""

    open_s: float
    exposure_s: float
    row_time_s: float = 0.0
    rows: int = 1

    @property
    def close_s(self) -> float:
        """End of the last row's exposure."""
        return self.open_s + self.exposure_s + self.row_time_s * (self.rows - 1)

    @property
    def middle_s(self) -> float:
        """Mid-exposure of the middle row, the time of the frame's truth."""
        return (self.open_s + self.close_s) / 2


def render(
    image: NDArray,
    sources: Sources,
    optics: Optics,
    trajectory: Trajectory,
    mount: Mount,
    window: Window,
    emitter: Emitter | None = None,
    occluded: OcclusionTest | None = None,
) -> SourceTruth:
    """Add the mean photo-electrons of every source to the (H, W) image, in place.

    Returns the truth of the sources that gave light to the chip.

    Each image moves along its true path while it is lit. A piece of the exposure in which it moves by less than its
    own blur is drawn as two points of light whose mean time and variance are those of the light in the piece (for
    steady light the two-point Gauss rule). Total light and mean position are exact for any pulses, and the streak's
    profile converges with the fourth power of the piece. In a rolling shutter every row has its own exposure.
    The numbers in the code are those of the module's steps.
    """
    # Times from the first row's opening to the last row's end.
    t_s = sample_times(window.open_s, window.close_s, trajectory)
    all_poses = poses(trajectory, mount, t_s)
    # 1. Coarse selection with a few poses, before the sources are projected at all of them.
    # It knows no motion of sources, so moving sources are all kept.
    if sources.motion is None:
        few_poses = taken(all_poses, slice(None, None, len(t_s) // 8))
        rows = in_view(sources, optics, few_poses)
    else:
        rows = np.arange(len(sources))
    if occluded:
        rows = rows[~occluded(sources.place[rows])]
    candidates = sources.take(rows)
    # 2. Project them at all poses; the pose in the middle gives the frame's truth.
    emitter = emitter or Emitter()
    middle = len(t_s) // 2
    tracks, distance_m, cos_in = image_tracks(candidates, optics, all_poses, t_s, emitter)
    # 3. Each source keeps the image K_n that it has at mid-exposure.
    middle_pose = taken(all_poses, middle)
    kernels = source_kernels(
        candidates,
        optics,
        tracks.xy_px[middle],
        distance_m,
        cos_in,
        led_images(candidates, optics, middle_pose, emitter),
    )
    # 4. and 5. Integrate and add to the frame.
    table = draw(image, tracks, kernels, STEP * kernels.sharp_px, window)
    return truth_on_chip(candidates.id, tracks, table, window)


def truth_on_chip(ids: Ints, tracks: Tracks, table: Floats, window: Window) -> SourceTruth:
    """The truth of the sources that gave light to the chip, from the table of `draw`."""
    on_chip = np.flatnonzero(table[:, 0] > 0)
    shown = table[on_chip]
    electrons, peak, _, _, squares, length = shown[:, :6].T.copy()
    return SourceTruth(
        id=ids[on_chip],
        xy_px=tracks.xy_px[len(tracks.xy_px) // 2, on_chip],
        flux_xy_px=shown[:, 2:4].copy(),
        electrons=electrons,
        peak_e=peak,
        streak_px=length,
        # Noise-equivalent area (sum I)^2 / sum I^2.
        area_px=electrons**2 / squares,
        peak_xy=shown[:, 6:8].astype(np.int64),
        saturated=np.zeros(len(electrons), bool),  # set by the detector, as is the SNR
        snr=np.full(len(electrons), np.nan),
        streak_xy_px=_streaks_px(tracks, on_chip, window),
    )


@jit
def _streaks_px(tracks: Tracks, which: Ints, window: Window) -> Floats:
    """(M, 2) displacement of some images over the exposure of the row that each is on at mid-exposure."""
    out = np.empty((len(which), 2))
    for m in range(len(which)):
        n = which[m]
        # A row's exposure begins row_time_s after that of the row above it.
        y = tracks.xy_px[tracks.xy_px.shape[0] // 2, n, 1]
        row = min(max(y, 0.0), window.rows - 1.0) if np.isfinite(y) else 0.0
        begin_s = window.open_s + window.row_time_s * row
        x0, y0, _ = _interpolate(tracks, n, begin_s)
        x1, y1, _ = _interpolate(tracks, n, begin_s + window.exposure_s)
        out[m, 0] = x1 - x0
        out[m, 1] = y1 - y0
    return out


def led_images(
    sources: Sources, optics: Optics, pose: Poses, emitter: Emitter
) -> DiskImages | None:
    """Geometric images of the LEDs' disks among N sources at one pose, NaN for stars; None if all are stars."""
    # Only LEDs with a size.
    led = np.flatnonzero(sources.radius_m * sources.place[:, 3] > 0)
    if not len(led):
        return None
    cam_from_lab, camera_m = pose
    offset_cam = (sources.xyz[led] - camera_m) @ cam_from_lab.T
    normal_cam = sources.normal[led] @ cam_from_lab.T
    images = disk_images(optics, emitter, offset_cam, normal_cam, sources.radius_m[led])
    if len(led) == len(sources):
        return images
    # Fill the rows of the stars with NaN.
    full = DiskImages(*(np.full((len(sources), *part.shape[1:]), np.nan) for part in images))
    for whole, part in zip(full, images, strict=True):
        whole[led] = part
    return full


def draw(
    image: NDArray, tracks: Tracks, kernels: Kernels, step_px: Floats, window: Window
) -> Floats:
    """Integrate every source on a patch of its own and add the patches to the image.

    Returns (N, 8): electrons on the chip, those of the brightest pixel, flux-weighted mean x and y, sum of the
    squared pixels, path length in pixels, and the brightest pixel's x and y. The mean is that of the whole image,
    except in a rolling shutter, where it is that of the part on the chip, since there each row has its own time.

    Parameters
    ----------
    step_px
        (N,) largest motion of each image in one piece of the exposure, px; for an ellipse in units of `sharpest_px`
    """
    boxes = patches(tracks.xy_px, kernels.reach_px, image.shape)
    areas = (boxes[:, 1] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 2])
    out = np.zeros((len(boxes), 8))
    budget = max(image.size, MAX_PATCH_PIXELS)
    # None: numba then leaves out the code of ellipses, the greater part of the renderer's, which a sky does not need.
    bessel = kernels.bessel if len(kernels.bessel) else None
    first = 0
    while first < len(boxes):
        # As many patches at once as memory allows, at least one.
        total = np.cumsum(areas[first:])
        last = first + max(1, int(np.searchsorted(total, budget, side="right")))
        starts = np.concatenate([[0], total[: last - first]])
        buffer = np.zeros(starts[-1])
        # Patches are drawn in parallel and added in order, so the sum does not depend on threads.
        parts = boxes[first:last]
        _draw(buffer, starts, parts, first, tracks, kernels, bessel, step_px, window, out)
        _deposit(image, buffer, starts, parts)
        first = last
    return out


@jit
def patches(xy_px: Floats, reach_px: Floats, shape: tuple[int, int]) -> Ints:
    """(N, 4) first column, last + 1, first row, last + 1 that each image can reach; empty where it misses the chip."""
    poses, count, _ = xy_px.shape
    out = np.zeros((count, 4), np.int64)
    for n in range(count):
        for axis in range(2):
            # Extent of the path, and the longest chord between two samples; a NaN leaves them unchanged.
            low = np.inf
            high = -np.inf
            jump = 0.0
            before = np.nan
            for k in range(poses):
                x = xy_px[k, n, axis]
                low = min(low, x)
                high = max(high, x)
                jump = max(jump, abs(x - before))
                before = x
            # A curved path leaves the chord; a quarter of it covers that.
            margin = reach_px[n] + 1 + jump / 4
            limit = shape[1 - axis]
            begin = min(max(np.floor(low - margin), 0.0), limit)
            out[n, 2 * axis] = begin
            out[n, 2 * axis + 1] = min(max(np.ceil(high + margin) + 1, begin), limit)
    return out


@jit(parallel=True)
def _draw(
    buffer: Any,
    starts: Any,
    boxes: Any,
    first: int,
    tracks: Tracks,
    kernels: Kernels,
    bessel: Singles | None,
    step_px: Floats,
    window: Window,
    out: Any,
) -> None:
    """Integrate the sources of these patches in parallel, each into its part of the buffer and its row of `out`."""
    for i in numba.prange(len(boxes)):
        x0, x1, y0, y1 = boxes[i]
        if x1 > x0 and y1 > y0:
            # Each patch is a part of one buffer.
            patch = buffer[starts[i] : starts[i + 1]].reshape(y1 - y0, x1 - x0)
            _expose_source(
                patch,
                x0,
                y0,
                first + i,
                tracks,
                kernels,
                bessel,
                step_px[first + i],
                window,
                out[first + i],
            )
            _patch_statistics(patch, x0, y0, window.row_time_s != 0, out[first + i])


@jit
def _expose_source(
    patch: Any,
    x0: int,
    y0: int,
    n: int,
    tracks: Tracks,
    kernels: Kernels,
    bessel: Singles | None,
    step_px: float,
    window: Window,
    row: Any,
) -> None:
    """Integrate one source on its patch, whose first pixel is (x0, y0).

    Writes the path length into row[5] and, without a rolling shutter, the light's mean position into row[2:4].
    """
    end_s = window.open_s + window.exposure_s
    # The table of an ellipse is made for this source alone; other kinds share tables.
    table = None if bessel is None else _sampled(n, kernels)
    if table is not None and len(table):
        step_px *= sharpest_px(table)
    row[5] = _length(tracks, n, window.open_s, end_s)
    # Without a rolling shutter all rows share one integral; with it each row needs its own interval.
    rolling = window.row_time_s != 0
    rows = 1 if rolling else len(patch)
    for j in range(0, len(patch), rows):
        delay_s = (y0 + j) * window.row_time_s
        begin_s = window.open_s + delay_s
        sums = _integrate(
            patch,
            j,
            j + rows,
            x0,
            y0,
            n,
            tracks,
            kernels,
            table,
            step_px,
            begin_s,
            end_s + delay_s,
        )
    # Mean position of the light itself where all rows share one interval, without the chip's cut.
    if not rolling and sums[0] > 0:
        row[2] = sums[1] / sums[0] + kernels.disk[n, 2]
        row[3] = sums[2] / sums[0] + kernels.disk[n, 3]


@jit
def _integrate(
    patch: Any,
    row0: int,
    row1: int,
    x0: int,
    y0: int,
    n: int,
    tracks: Tracks,
    kernels: Kernels,
    table: Singles | None,
    step_px: float,
    begin_s: float,
    end_s: float,
) -> Any:
    """Add the light of one source from begin_s to end_s to the rows [row0, row1) of its patch.

    1. The interval is cut into equal pieces, short enough that the image moves by less than its blur in each.
    2. In a piece the light has a duration `lit`, a mean time and a standard deviation `spread` (from the pulses).
    3. Two points of half the light each, at mean - spread and mean + spread, reproduce these moments: for steady light
       spread = length / (2 sqrt 3), which is the two-point Gauss-Legendre rule, with an error of the fourth order in
       the length. An image that hardly moves within the piece needs one point. Lateral color makes each several.

    Returns the electrons of the whole image and their first moments in x and y.
    """
    total = 0.0
    total_x = 0.0
    total_y = 0.0
    speed = _speed(tracks, n, begin_s, end_s)
    steps = speed * (end_s - begin_s) / step_px
    # 1. One piece more than the motion needs: in a short path the ends, where the error is largest, weigh more.
    pieces = 1 if steps < SINGLE_PIECE_STEPS else int(min(np.ceil(steps) + 1, MAX_PIECES))
    for k in range(pieces):
        a = begin_s + (end_s - begin_s) * k / pieces
        b = begin_s + (end_s - begin_s) * (k + 1) / pieces
        # 2. Duration, mean and standard deviation of the light's times in this piece.
        lit, mean, spread = lit_moments_s(
            a, b, tracks.pulse_s[n, 0], tracks.pulse_s[n, 1], tracks.pulse_s[n, 2]
        )
        if lit <= 0:  # no pulse in this piece
            continue
        # 3. One point at the mean, or two at mean -+ spread.
        points = 1 if speed * spread < STILL_PX else 2
        for p in range(points):
            x, y, rate = _interpolate(tracks, n, mean + spread * (2 * p - points + 1))
            e = rate * lit / points
            if not e > 0:  # no image at this time (NaN position), or the LED faces away
                continue
            for part in range(kernels.parts.shape[1]):
                share, dx, dy = kernels.parts[n, part]
                _splat_point(
                    patch, row0, row1, x - x0 + dx, y - y0 + dy, e * share, n, kernels, table
                )
            total = total + e
            total_x = total_x + e * x
            total_y = total_y + e * y
    return total, total_x, total_y


@jit
def _sampled(n: int, kernels: Kernels) -> Any:
    """The sampled image of an ellipse; empty for other kinds of kernel."""
    if kernels.kind[n] != ELLIPSE:
        return np.empty((0, 0, 0), np.float32)
    begin, end, waves, samples = kernels.table[n]
    disk = EllipseDisk(*to_fixed_tuple(kernels.disk[n], DISK_FIELDS))
    return ellipse_table(disk, kernels.tables[begin:end], waves, samples, kernels.bessel)


@jit
def _splat_point(
    patch: Any,
    row0: int,
    row1: int,
    x: float,
    y: float,
    electrons: float,
    n: int,
    kernels: Kernels,
    table: Singles | None,
) -> None:
    """Add the image of a point of light at (x, y) of the patch, by the source's kind of kernel."""
    # Numbers of a table: its place in `tables` and the size of its axes.
    begin, end, p, q = kernels.table[n]
    if kernels.kind[n] == GAUSS:
        add_gaussian(patch, row0, row1, x, y, electrons, kernels.sigma_px[n])
    elif kernels.kind[n] == ROUND:
        add_round(patch, row0, row1, x, y, electrons, kernels.tables[begin:end].reshape(p, q))
    elif table is not None and kernels.kind[n] == ELLIPSE:
        add_ellipse(
            patch,
            row0,
            row1,
            x + kernels.disk[n, 0],
            y + kernels.disk[n, 1],
            electrons,
            table,
        )
    else:
        add_grid(
            patch, row0, row1, x, y, electrons, kernels.tables[begin:end].reshape(p, p, q, q)
        )


@jit
def _interpolate(tracks: Tracks, n: int, t_s: float) -> Any:
    """Position and rate of a source at any time, by the cubic (Lagrange) through the four nearest samples.

    f(u) = sum_i w_i f_i with w_i = product over j != i of (u - j) / (i - j), u in steps from the first of the four.
    The rate is 0 where the source has no image.
    """
    last = tracks.xy_px.shape[0] - 4
    u = (t_s - tracks.first_s) / tracks.step_s
    # Two samples before the time and two after it, where there are.
    k = min(max(int(u) - 1, 0), last)
    u -= k
    w0 = (u - 1) * (u - 2) * (u - 3) / -6
    w1 = u * (u - 2) * (u - 3) / 2
    w2 = u * (u - 1) * (u - 3) / -2
    w3 = u * (u - 1) * (u - 2) / 6
    xy = tracks.xy_px
    rate = tracks.rate_e_s
    x = w0 * xy[k, n, 0] + w1 * xy[k + 1, n, 0] + w2 * xy[k + 2, n, 0] + w3 * xy[k + 3, n, 0]
    y = w0 * xy[k, n, 1] + w1 * xy[k + 1, n, 1] + w2 * xy[k + 2, n, 1] + w3 * xy[k + 3, n, 1]
    e = w0 * rate[k, n] + w1 * rate[k + 1, n] + w2 * rate[k + 2, n] + w3 * rate[k + 3, n]
    return x, y, (e if np.isfinite(x + y) else 0.0)


@jit
def _speed(tracks: Tracks, n: int, begin_s: float, end_s: float) -> float:
    """The greatest speed of a source's image between two times, px/s, by differences of samples."""
    first = max(int((begin_s - tracks.first_s) / tracks.step_s), 0)
    last = min(
        int(np.ceil((end_s - tracks.first_s) / tracks.step_s)), tracks.xy_px.shape[0] - 1
    )
    fastest = 0.0
    for k in range(first, last):
        dx = tracks.xy_px[k + 1, n, 0] - tracks.xy_px[k, n, 0]
        dy = tracks.xy_px[k + 1, n, 1] - tracks.xy_px[k, n, 1]
        fastest = max(fastest, np.hypot(dx, dy) / tracks.step_s)  # a NaN leaves it unchanged
    return fastest


@jit
def _length(tracks: Tracks, n: int, begin_s: float, end_s: float) -> float:
    """Path length of a source's image between two times, px, as a sum of chords between samples."""
    # As many chords as samples, eight at least.
    chords = max(int(np.ceil((end_s - begin_s) / tracks.step_s)), 8)
    total = 0.0
    x, y, _ = _interpolate(tracks, n, begin_s)
    for k in range(chords):
        x1, y1, _ = _interpolate(tracks, n, begin_s + (end_s - begin_s) * (k + 1) / chords)
        chord = np.hypot(x1 - x, y1 - y)
        total += chord if np.isfinite(chord) else 0.0
        x = x1
        y = y1
    return total


@jit
def _patch_statistics(patch: Any, x0: int, y0: int, rolling: bool, row: Any) -> None:
    """Write a finished patch's sum, peak, sum of squares and brightest pixel into row[0, 1, 4, 6, 7].

    Of a rolling shutter also the patch's center of gravity, (sum e x, sum e y) / sum e, into row[2, 3].
    """
    x = 0.0
    y = 0.0
    for j in range(patch.shape[0]):
        for i in range(patch.shape[1]):
            e = patch[j, i]
            row[0] += e
            row[4] += e * e
            x = x + e * i
            y = y + e * j
            if e > row[1]:
                row[1] = e
                row[6] = x0 + i
                row[7] = y0 + j
    if rolling and row[0] > 0:
        row[2] = x0 + x / row[0]
        row[3] = y0 + y / row[0]


@jit
def _deposit(image: Any, buffer: Any, starts: Any, boxes: Any) -> None:
    """Add all patches to the image, one after another: patches overlap, so threads would collide."""
    for i in range(len(boxes)):
        x0, x1, y0, y1 = boxes[i]
        k = starts[i]
        width = x1 - x0
        for j in range(y0, y1):
            row = image[j, x0:x1]
            pixels = buffer[k : k + width]
            for x in range(width):
                row[x] += pixels[x]
            k += width
