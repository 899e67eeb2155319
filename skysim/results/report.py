"""Annotated frames, plots and one self-contained HTML page of a run."""

from __future__ import annotations

import base64
import io as std_io
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core.files import write_text
from skysim.core.types import Floats, Row, SourceTruth

TRUTH_BGR, FOUND_BGR, MATCHED_BGR = (200, 160, 60), (80, 80, 235), (110, 220, 90)


def stretch(image: NDArray) -> NDArray[np.uint8]:
    """(H, W) frame as uint8 for display: clipped to black and white levels, then a square-root curve.

    Black is the 30th percentile (the sky). White is the 99.95th percentile, or a quarter of the peak if that is
    higher, so that a few bright sources do not leave a large part of the image white.
    """
    low, high = np.percentile(image, (30, 99.95))
    high = max(high, low + 1.0, float(image.max()) * 0.25)
    return (255 * np.sqrt(np.clip((image - low) / (high - low), 0, 1))).astype(np.uint8)


def annotate(
    image: NDArray,
    found_px: Floats,
    matched_px: Floats,
    labels: list[str] | None = None,
    truth_px: Floats | None = None,
) -> NDArray[np.uint8]:
    """The stretched frame in BGR with blue ticks (truth), red squares (detections), green circles (matched stars).

    All markers leave their center open. A frame smaller than 1000 pixels is enlarged twice, so that the markers do
    not cover its stars. `labels` are written beside the matched stars.
    """
    scale = 2 if max(image.shape) < 1000 else 1
    picture = cv2.cvtColor(stretch(image), cv2.COLOR_GRAY2BGR)
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    size = max(8, min(picture.shape[:2]) // 70)
    for x, y in places(truth_px, scale):
        ticks(picture, x, y, size, TRUTH_BGR)
    for x, y in places(found_px, scale):
        cv2.rectangle(picture, (x - size, y - size), (x + size, y + size), FOUND_BGR, 1)
    for n, (x, y) in enumerate(places(matched_px, scale)):
        cv2.circle(picture, (x, y), size + 4, MATCHED_BGR, 1, cv2.LINE_AA)
        if labels:
            write(picture, labels[n], x + size + 6, y + 4, MATCHED_BGR)
    return picture


def preview(image: NDArray, seen: SourceTruth) -> NDArray[np.uint8]:
    """The stretched frame in BGR with ticks at the flux centroid of each true source and the 40 brightest labeled.

    Blue marks unsaturated sources, red those expected to saturate. A frame smaller than 1000 pixels is enlarged twice.
    """
    scale = 2 if max(image.shape) < 1000 else 1
    picture = cv2.cvtColor(stretch(image), cv2.COLOR_GRAY2BGR)
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    size = max(8, min(picture.shape[:2]) // 70)
    named = set(np.argsort(-seen.electrons)[:40].tolist())
    for n, (x, y) in enumerate(places(seen.flux_xy_px, scale)):
        colour = FOUND_BGR if seen.saturated[n] else TRUTH_BGR
        ticks(picture, x, y, size, colour)
        if n in named:
            write(picture, str(seen.id[n]), x + size + 2, y - size, colour)
    return picture


def ticks(picture: NDArray[np.uint8], x: int, y: int, size: int, colour: tuple[int, int, int]) -> None:
    """Draw four strokes around (x, y), with an open center."""
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        begin, end = size - 4, size + 6
        cv2.line(picture, (x + begin * dx, y + begin * dy), (x + end * dx, y + end * dy), colour, 1)


def write(picture: NDArray[np.uint8], text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
    """Draw a small label with its lower left corner at (x, y)."""
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)


def contact_sheet(images: list[NDArray], captions: list[str], scale: int) -> NDArray[np.uint8]:
    """Frames of one size side by side, enlarged `scale` times and captioned.

    All use the black and white levels of the first frame, so that their brightnesses can be compared.
    """
    low, high = np.percentile(images[0], 30), float(np.percentile(images[0], 99.95))
    strips = []
    for image, caption in zip(images, captions, strict=True):
        grey = (255 * np.sqrt(np.clip((image - low) / (high - low), 0, 1))).astype(np.uint8)
        large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
        picture = cv2.copyMakeBorder(large, 24, 2, 2, 2, cv2.BORDER_CONSTANT, value=40)
        write(picture, caption, 6, 16, (255, 255, 255))
        strips.append(picture)
    return np.hstack(strips)


def places(xy_px: Floats | None, scale: int) -> list[tuple[int, int]]:
    """Integer pixel positions in an image enlarged `scale` times; empty for None.

    Pixel centers are at integers, so the center of pixel x moves to x * scale + (scale - 1) / 2.
    """
    if xy_px is None:
        return []
    return [(round(x), round(y)) for x, y in xy_px * scale + (scale - 1) / 2]


def summary(rows: list[Row]) -> dict[str, Any]:
    """Frame counts, median and worst errors in arcseconds, and median solve time of a run.

    Errors are over solved frames, wrong ones included; NaN if no frame was solved.
    """
    solved = [row for row in rows if row.status == "solved"]
    cross = np.array([row.cross_arcsec for row in solved]) if solved else np.array([np.nan])
    roll = np.abs([row.roll_arcsec for row in solved]) if solved else np.array([np.nan])
    return {
        "frames": len(rows),
        "solved": len(solved),
        "wrong": sum(row.wrong for row in solved),
        "cross_arcsec_median": float(np.median(cross)),
        "cross_arcsec_worst": float(np.max(cross)),
        "roll_arcsec_median": float(np.median(roll)),
        "roll_arcsec_worst": float(np.max(roll)),
        "time_ms_median": float(np.median([row.time_ms for row in rows])),
    }


def as_dicts(rows: list[Row]) -> list[dict[str, Any]]:
    return [asdict(row) for row in rows]


@dataclass(frozen=True, slots=True)
class Images:
    """Images of a page: annotated frame, telemetry plot (PNG bytes), image files of the laboratory (may be empty)."""

    annotated: NDArray[np.uint8]
    flight: bytes
    lab: list[Path]


def write_page(
    path: Path,
    title: str,
    command: str,
    angles: tuple[str, str, str],
    rows: list[Row],
    stages_ms: dict[str, float],
    images: Images,
) -> None:
    """Write one HTML file with its images embedded: statistics, plots, an annotated frame, the table, the command.

    angles : names of the three angles of a row; stages_ms : median time by stage.
    """
    from jinja2 import Environment

    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(PAGE)
    text = page.render(
        title=title,
        command=command,
        angles=angles,
        rows=rows,
        summary=summary(rows),
        stages_ms=stages_ms,
        picture=embed(cv2.imencode(".png", images.annotated)[1].tobytes()),
        flight=embed(images.flight),
        lab=[embed(path.read_bytes(), path.suffix[1:]) for path in images.lab],
        figure=embed(figure(rows)),
    )
    write_text(path, text)


def embed(image: bytes, kind: str = "png") -> str:
    return f"data:image/{kind};base64," + base64.b64encode(image).decode()


def figure(rows: list[Row]) -> bytes:
    """Errors, detected and matched sources, and rate against time, as PNG. Red lines mark unsolved frames."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=(10, 6.4), layout="constrained")
    errors, stars, rate = fig.subplots(3, 1, sharex=True, height_ratios=[2, 1, 1])
    solved = [row for row in rows if row.status == "solved"]
    t = [row.t_s for row in solved]
    errors.semilogy(t, [max(row.cross_arcsec, 1e-6) for row in solved], ".-", label="cross-boresight")
    errors.semilogy(t, [max(abs(row.roll_arcsec), 1e-6) for row in solved], ".-", label="roll")
    for row in rows:
        if row.status != "solved":
            errors.axvline(row.t_s, color="tab:red", alpha=0.4)
    errors.set_ylabel("error [arcsec]")
    errors.legend()
    everything = [row.t_s for row in rows]
    stars.plot(everything, [row.detected for row in rows], label="detected")
    stars.plot(everything, [row.matched for row in rows], label="matched")
    stars.set_ylabel("lights")
    stars.set_ylim(bottom=0)
    stars.legend()
    rate.plot(everything, [row.rate_deg_s for row in rows], color="tab:green")
    rate.set_ylabel("rate [deg/s]")
    rate.set_xlabel("time [s]")
    for axes in (errors, stars, rate):
        axes.grid(alpha=0.3)
    buffer = std_io.BytesIO()
    fig.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{{ title }}</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1100px; margin: 2rem auto; padding: 0 1rem }
 h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.1rem; margin-top: 2rem }
 code { background: #f2f2f2; padding: .15rem .4rem; border-radius: 3px }
 img { max-width: 100%; border: 1px solid #ddd }
 .figures { display: flex; flex-wrap: wrap; gap: 1.2rem; margin: 1.2rem 0 }
 .figures div { background: #f6f8fa; padding: .6rem 1rem; border-radius: 6px }
 .figures b { display: block; font-size: 1.25rem } .bad { color: #b00020 }
 table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; width: 100% }
 th, td { text-align: right; padding: .2rem .5rem; border-bottom: 1px solid #eee }
 th { position: sticky; top: 0; background: #fff } td.status { text-align: left }
 .key span { margin-right: 1.2rem }
</style></head><body>
<h1>{{ title }}</h1>
<p><code>{{ command }}</code></p>
<div class="figures">
 <div><b>{{ summary.solved }} / {{ summary.frames }}</b>frames solved</div>
 <div><b class="{{ 'bad' if summary.wrong else '' }}">{{ summary.wrong }}</b>wrong attitudes (over 10\u2032)</div>
 <div><b>{{ '%.3g'|format(summary.cross_arcsec_median) }}\u2033 / {{ '%.3g'|format(summary.cross_arcsec_worst) }}\u2033
 </b>cross-boresight error, median / worst</div>
 <div><b>{{ '%.3g'|format(summary.roll_arcsec_median) }}\u2033 / {{ '%.3g'|format(summary.roll_arcsec_worst) }}\u2033
 </b>roll error, median / worst</div>
 <div><b>{{ '%.1f'|format(summary.time_ms_median) }} ms</b>median, image to attitude</div>
</div>
<h2>The run</h2><img alt="errors, lights and rate against time" src="{{ figure }}">
<h2>The flight</h2><img alt="attitude, beliefs and actuators against time" src="{{ flight }}">
{% if lab %}<h2>The laboratory</h2>
{% for image in lab %}<img class="lab" alt="the laboratory in 3-D" src="{{ image }}">{% endfor %}{% endif %}
<h2>The last solved frame</h2>
<p class="key"><span>blue ticks: truth</span><span>red squares: detected</span>
<span>green circles: identified</span></p>
<img alt="frame with truth, detections and identified stars" src="{{ picture }}">
<h2>Where the time goes</h2>
<p>{% for stage, ms in stages_ms.items() %}{{ stage }} {{ '%.2f'|format(ms) }} ms{{ ', ' if not loop.last }}{% endfor %}
 (medians a frame)</p>
<h2>Frames</h2>
<table><tr><th>frame</th><th>t [s]</th><th>rate [deg/s]</th>
{% for angle in angles %}<th>true {{ angle }} [deg]</th>{% endfor %}
{% for angle in angles %}<th>{{ angle }} [deg]</th>{% endfor %}
<th>cross [\u2033]</th><th>roll [\u2033]</th><th>detected</th><th>used</th><th>ms</th><th>status</th></tr>
{% for row in rows %}
<tr><td>{{ row.frame }}</td><td>{{ '%.3f'|format(row.t_s) }}</td><td>{{ '%.2f'|format(row.rate_deg_s) }}</td>
{% for angle in row.truth_deg %}<td>{{ '%.5f'|format(angle) }}</td>{% endfor %}
{% for angle in row.estimate_deg or ('', '', '') %}<td>{{ '%.5f'|format(angle) if angle != '' }}</td>{% endfor %}
<td>{{ '%.3f'|format(row.cross_arcsec) if row.estimate_deg }}</td>
<td>{{ '%.3f'|format(row.roll_arcsec) if row.estimate_deg }}</td>
<td>{{ row.detected }}</td><td>{{ row.matched }}</td><td>{{ '%.1f'|format(row.time_ms) }}</td>
<td class="status {{ 'bad' if row.wrong }}">{{ 'WRONG' if row.wrong else row.status }}</td></tr>
{% endfor %}
</table></body></html>
"""
