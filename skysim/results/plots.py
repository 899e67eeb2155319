"""Plot style shared by all figures (colors, lines, markers), and rendering of a figure to PNG."""

import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from skysim.core.constants import SIGMA_PER_MAD
from skysim.core.types import Array, Bools, Floats, Record, SourceTruth, median

Picture = Array[np.uint8]  # (H, W) gray, or (H, W, 3) BGR
Color = tuple[int, int, int]  # BGR
DPI = 120
# Palette for color-blind readers (Okabe & Ito 2008), plus two colors.
INK = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#882255"]
MARKS = "osD^vP<X"
LOOK: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.grid": True,
    "grid.color": "#e8e8e8",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "text.parse_math": False,
    "lines.markersize": 4.5,
    "hatch.color": "#b8b8b8",
    "hatch.linewidth": 0.7,
}


def png(draw: Callable[[Any], None], size_in: tuple[float, float]) -> bytes:
    """PNG bytes of the figure that `draw` fills, in the shared style, without a software tag (reproducible bytes)."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(LOOK):
        fig = Figure(figsize=size_in, layout="constrained")
        draw(fig)
        plain_labels(fig)
        return figure_png(fig, dpi=DPI, metadata={"Software": None})


def plain_labels(fig: Any) -> None:
    """Label the ticks of logarithmic axes as numbers: the style has no mathematical text."""
    from matplotlib.ticker import LogFormatter, LogFormatterMathtext

    class Plain(LogFormatter):
        """A number wherever powers would have a label."""

        def __call__(self, x: float, pos: Any = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    for axis in (one for axes in fig.axes for one in (axes.xaxis, axes.yaxis)):
        if isinstance(axis.get_major_formatter(), LogFormatterMathtext):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(Plain())


def figure_png(fig: Any, **options: Any) -> bytes:
    """PNG bytes of a figure, with options of `savefig`."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", **options)
    return buffer.getvalue()


def stacked_axes(heights_in: Sequence[float]) -> tuple[Any, list[Any]]:
    """A figure with one panel above the other over a common time axis, heights in inches, and its axes from the top.

    The margins are fixed: to measure all labels first (`layout="constrained"`) doubles the time of drawing.
    """
    from matplotlib.figure import Figure

    width_in = 10
    left_in = 0.95
    right_in = 0.15
    top_in = 0.12
    bottom_in = 0.55
    gap_in = 0.15
    height_in = top_in + sum(heights_in) + gap_in * (len(heights_in) - 1) + bottom_in
    fig = Figure(figsize=(width_in, height_in))
    grid = fig.add_gridspec(
        len(heights_in),
        height_ratios=heights_in,
        left=left_in / width_in,
        right=1 - right_in / width_in,
        bottom=bottom_in / height_in,
        top=1 - top_in / height_in,
        hspace=gap_in * len(heights_in) / sum(heights_in),
    )
    stack = list(grid.subplots(sharex=True, squeeze=False)[:, 0])
    for axes in stack:
        axes.grid(alpha=0.3)
    stack[-1].set_xlabel("time [s]")
    return fig, stack


# Convert frames to 8-bit images for display, and encode them as JPEG.


CURVES: Record = {
    "square root": np.sqrt,
    "linear": lambda fraction: fraction,
    "logarithm": lambda fraction: np.log1p(200 * fraction) / np.log1p(200),
}
SAMPLE_STRIDE = 8  # stride in rows and columns of the sample for the sky statistics


class FrameStatistics(NamedTuple):
    """Statistics of a frame: sky median, sky standard deviation and peak, all in DN; number of saturated pixels."""

    sky_dn: float
    scatter_dn: float
    peak_dn: float
    saturated: int


def display_levels(image: Array) -> tuple[float, float]:
    """Black and white levels in DN: the sky (30th percentile), and the 99.9th percentile or, if that is higher,
    a quarter of the way from the sky to the brightest pixel."""
    low, high = np.percentile(image[::SAMPLE_STRIDE, ::SAMPLE_STRIDE], (30, 99.9))
    return float(low), max(float(high), float(low + 0.25 * (image.max() - low)))


def to_8bit(
    image: Array, curve: str, levels_dn: tuple[float, float] | None = None
) -> Picture:
    """(H, W) uint8 image, stretched from the black level to the white level by one of CURVES.

    A uint16 frame is mapped through a lookup table, which is faster than evaluating the curve at each pixel.

    Parameters
    ----------
    levels_dn
        Black and white levels, for example of another frame; by default those of
        `display_levels`
    """
    low, high = levels_dn or display_levels(image)
    top = low + max(
        high - low, 1.0
    )  # at least 1 DN, to avoid division by zero in a flat frame
    tabulated = image.dtype == np.uint16
    levels = np.arange(int(image.max()) + 1) if tabulated else image
    stretched = 255 * CURVES[curve](np.clip((levels - low) / (top - low), 0, 1))
    gray = stretched.astype(np.uint8)
    return gray[image] if tabulated else gray


def frame_statistics(image: Array, saturation_dn: float) -> FrameStatistics:
    """Sky median and standard deviation from a sample of the pixels; peak and saturation count from all of them.

    Stars are excluded from the standard deviation by a clip at five sigma, with sigma = 1.4826 x the median absolute
    deviation (exact for a Gaussian). The limit is at least 3 DN, because in digitized frames the median and the
    deviation are integers and the deviation can be 0.
    """
    sample = image[:: 2 * SAMPLE_STRIDE, ::SAMPLE_STRIDE].astype(float)
    sky = median(sample)
    deviation = np.abs(sample - sky)
    background = sample[deviation <= max(5 * SIGMA_PER_MAD * median(deviation), 3.0)]
    peak = float(image.max())
    saturated = int(np.count_nonzero(image >= saturation_dn)) if peak >= saturation_dn else 0
    return FrameStatistics(sky, float(background.std()), peak, saturated)


def reduce_width(image: Picture, max_width_px: int) -> Picture:
    """The image reduced to at most `max_width_px` columns; area averaging, so that no star is skipped."""
    height, width = image.shape[:2]
    if width <= max_width_px:
        return image
    size = max_width_px, max(round(height * max_width_px / width), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(gray: Picture) -> bytes:
    """The image as JPEG bytes for the browser."""
    return bytes(cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, 88])[1])


LEGEND_PX = 20  # height of the legend
MIN_SNR = 3.0  # of the true sources that are marked: no one sees fainter ones
TRUTH_BGR = (200, 160, 60)
DETECTED_BGR = (80, 80, 235)
MATCHED_BGR = (110, 220, 90)


def enlarged(image: Array) -> tuple[Picture, int, int]:
    """The stretched frame in BGR, its scale (2 if smaller than 1000 pixels), and the size of markers in pixels."""
    scale = 2 if max(image.shape) < 1000 else 1
    picture = cv2.cvtColor(to_8bit(image, "square root"), cv2.COLOR_GRAY2BGR)
    picture = np.asarray(
        cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST),
        np.uint8,
    )
    return picture, scale, max(8, min(picture.shape[:2]) // 70)


def visible(sources: SourceTruth) -> Bools:
    """(N,) whether a true source has a signal-to-noise ratio above MIN_SNR, or none is known."""
    return ~(sources.snr <= MIN_SNR)


def annotate(
    image: Array,
    detected_px: Floats,
    matched_px: Floats,
    labels: list[str] | None = None,
    truth_px: Floats | None = None,
) -> Picture:
    """The stretched frame in BGR with blue ticks (truth), red squares (detections), green circles (matched stars).

    All markers leave their center open. A frame smaller than 1000 pixels is enlarged twice, so that the markers do
    not cover its stars. `labels` are written beside the matched stars. With a truth there is a legend below.
    """
    picture, scale, size = enlarged(image)
    for x, y in pixel_positions(truth_px, scale):
        draw_ticks(picture, x, y, size, TRUTH_BGR)
    for x, y in pixel_positions(detected_px, scale):
        cv2.rectangle(picture, (x - size, y - size), (x + size, y + size), DETECTED_BGR, 1)
    for n, (x, y) in enumerate(pixel_positions(matched_px, scale)):
        cv2.circle(picture, (x, y), size + 4, MATCHED_BGR, 1, cv2.LINE_AA)
        if labels:
            draw_label(picture, labels[n], x + size + 6, y + 4, MATCHED_BGR)
    if truth_px is None:
        return picture
    meanings = {
        f"true, SNR > {MIN_SNR:g}": TRUTH_BGR,
        "detected": DETECTED_BGR,
        "matched": MATCHED_BGR,
    }
    return with_legend(picture, meanings)


def annotate_truth(image: Array, sources: SourceTruth) -> Picture:
    """The stretched frame in BGR with ticks at the flux centroid of each visible source and the 40 brightest labeled.

    Blue marks unsaturated sources, red those expected to saturate. A frame smaller than 1000 pixels is enlarged twice.
    """
    # Here, since it imports the sections of a scene, which the picture of a solved file does without.
    from skysim.sources.satellites import light_name

    picture, scale, size = enlarged(image)
    labeled = set(np.argsort(-sources.electrons)[:40].tolist())
    seen = visible(sources)
    for n, (x, y) in enumerate(pixel_positions(sources.flux_xy_px, scale)):
        if not seen[n]:
            continue
        color = DETECTED_BGR if sources.saturated[n] else TRUTH_BGR
        draw_ticks(picture, x, y, size, color)
        if n in labeled:
            draw_label(picture, light_name(int(sources.id[n])), x + size + 2, y - size, color)
    return with_legend(
        picture, {f"true, SNR > {MIN_SNR:g}": TRUTH_BGR, "saturated": DETECTED_BGR}
    )


def with_legend(picture: Picture, meanings: dict[str, Color]) -> Picture:
    """The picture with a strip below it that names the colors of its markers; pixels keep their places."""
    strip = cv2.copyMakeBorder(
        picture, 0, LEGEND_PX, 0, 0, cv2.BORDER_CONSTANT, value=(0, 0, 0)
    )
    x = 6
    for text, color in meanings.items():
        draw_label(strip, text, x, len(strip) - 6, color)
        x += 14 + 8 * len(text)
    return np.asarray(strip, np.uint8)


def draw_ticks(picture: Picture, x: int, y: int, size: int, color: Color) -> None:
    """Draw four strokes around (x, y), with an open center."""
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        begin = size - 4
        end = size + 6
        cv2.line(
            picture, (x + begin * dx, y + begin * dy), (x + end * dx, y + end * dy), color, 1
        )


def draw_label(picture: Picture, text: str, x: int, y: int, color: Color) -> None:
    """Draw a small label with its lower left corner at (x, y)."""
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA)


def pixel_positions(xy_px: Floats | None, scale: int) -> list[tuple[int, int]]:
    """Integer pixel positions in an image enlarged `scale` times; empty for None.

    Pixel centers are at integers, so the center of pixel x moves to x * scale + (scale - 1) / 2.
    """
    if xy_px is None:
        return []
    return [(round(x), round(y)) for x, y in xy_px * scale + (scale - 1) / 2]
