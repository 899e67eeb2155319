"""Strip charts of a flight: curves against a common time axis, one chart above the other, with a shared cursor."""

import math
from collections.abc import Sequence
from dataclasses import field
from operator import attrgetter

import numpy as np
from nicegui import ui

from skysim.apps.gui.messages import Curves, FlightRow, LightName, Residual
from skysim.apps.gui.views.style import CURVE_COLORS, RULE, TOOLTIP, chart_color
from skysim.apps.gui.views.widgets import Contents
from skysim.core.types import Record, frozen

BAND_COLOR = "#8b95a5"
STRIP_PX = 118  # height of a strip
HEAD_PX = 22  # height of its title and legend
AXIS_PX = 24  # height of the time axis
INNER_PX = STRIP_PX - HEAD_PX - 8  # height of a strip between its axes
FLOOR = 1e-3  # arcsec; lower limit of errors on a logarithmic axis
MAX_DOTS = 20_000  # maximum number of dots; if there are more, some frames are left out
Points = list[list[float]]
LEFT_PX = 52  # distance of a strip from the left edge of the chart
RIGHT_PX = 12
ZOOM = {
    "type": "inside",
    "xAxisIndex": "all",
    "zoomOnMouseWheel": "ctrl",
    "moveOnMouseMove": "shift",
    "moveOnMouseWheel": False,
    "filterMode": "none",
}
# A click on a strip, and the line of the shown moment over all strips. The line is a separate element, because the
# chart would draw all curves again for it.
CHART_JS = """() => {
  const chart = getElement(%d).chart;
  if (skysimMoment.chart !== chart) {
    const line = document.createElement("div");
    line.className = "lab-moment";
    chart.getDom().append(line);
    Object.assign(skysimMoment, { chart, line });
    chart.getZr().on("click", event => {
      const at = [event.offsetX, event.offsetY];
      chart.getOption().grid.forEach((_, gridIndex) => {
        if (!chart.containPixel({ gridIndex }, at)) return;
        emitEvent("moment", chart.convertFromPixel({ gridIndex }, at)[0]);
      });
    });
  }
  skysimMoment(skysimMoment.t_s ?? 0);
  getElement(%d)?.attach(chart);
}"""
MOMENT_JS = f"""
window.skysimMoment = (t_s) => {{
  const {{ chart, line }} = skysimMoment;
  skysimMoment.t_s = t_s;
  if (!chart) return;
  const x = chart.convertToPixel({{ xAxisIndex: 0 }}, t_s);
  line.hidden = !(x >= {LEFT_PX} && x <= chart.getWidth() - {RIGHT_PX});
  line.style.transform = `translateX(${{x}}px)`;
}};
"""


@frozen
class StripCurve:
    """One curve of a strip.

    Attributes
    ----------
    kind
        line, dots (a value per frame), or band (an area of 3 standard errors)
    """

    name: str
    points: Points
    kind: str = "line"


@frozen
class Strip:
    """One chart with its unit in the title.

    Attributes
    ----------
    dots
        Dots of lights, drawn by strips.js: time, value, number of the light
    """

    title: str
    curves: tuple[StripCurve, ...] = ()
    logarithmic: bool = False
    dots: Points = field(default_factory=list)

    @property
    def drawn(self) -> tuple[StripCurve, ...]:
        return tuple(curve for curve in self.curves if curve.points)


class Dots(ui.element, component="js/strips.js"):  # type: ignore[call-arg]
    """Dots over a strip, implemented in strips.js."""


def strips(
    rows: Sequence[FlightRow], log: Curves, residuals: Sequence[Residual]
) -> list[Strip]:
    """Return the strips for which a flight has data.

    Parameters
    ----------
    residuals
        Residuals of the identified lights, as in `FlightStep`
    """

    def of_frames(
        name: str, field: str, kind: str = "line", factor: int = 1, least: float = -math.inf
    ) -> StripCurve:
        found = ((one.row.t_s, factor * attrgetter(field)(one)) for one in rows)
        points = [point(t_s, max(value, least)) for t_s, value in found if value == value]
        return StripCurve(name, points, kind)

    def of_motion(name: str) -> StripCurve:
        return StripCurve(name, [*map(point, log.get("t_s", ()), log.get(name, ()))])

    found = [
        Strip(
            "cross-boresight error, ″",
            (
                of_frames("tracker", "row.cross_arcsec", "dots", least=FLOOR),
                of_frames("3σ", "row.cross_sigma_arcsec", "band", 3),
            ),
            logarithmic=True,
        ),
        Strip(
            "roll error, ″",
            (
                of_frames("tracker", "row.roll_arcsec", "dots"),
                of_frames("−3σ", "row.roll_sigma_arcsec", "band", -3),
                of_frames("+3σ", "row.roll_sigma_arcsec", "band", 3),
            ),
        ),
        Strip(
            "attitude error, ″",
            (
                *map(of_motion, ("pointing", "IMU alone", "filter")),
                of_frames("innovation", "innovation_arcsec", "dots"),
            ),
            logarithmic=True,
        ),
        Strip(
            "lights",
            (
                of_frames("in the field", "lights"),
                of_frames("identified", "row.matched"),
            ),
        ),
        Strip("residual of each light, px", dots=thinned(residuals)),
        Strip("rate, °/s", (of_motion("rate"),)),
        Strip("momentum, N m s", (of_motion("momentum"),)),
    ]
    return [strip for strip in found if strip.drawn or strip.dots]


def point(t_s: float, value: float) -> list[float]:
    """A point of a curve, rounded to the digits that are drawn."""
    return [float(f"{t_s:.4f}"), float(f"{value:.5g}")]


def thinned(residuals: Sequence[Residual]) -> Points:
    """The residuals as dots: of all frames or, if they are more than MAX_DOTS, of frames at equal steps."""
    times_s = sorted({one.t_s for one in residuals})
    kept = set(times_s[:: max(math.ceil(len(residuals) / MAX_DOTS), 1)])
    return [
        [round(t_s, 4), float(f"{px:.3g}"), id] for t_s, id, px, _ in residuals if t_s in kept
    ]


class StripChart:
    """The chart; a click on a strip emits the page's event `moment` with the time there.

    Attributes
    ----------
    contents
        Contents of the tab's live fields
    strips
        Strips that are drawn
    """

    def __init__(self, contents: Contents) -> None:
        self.contents = contents
        self.strips: list[Strip] = []
        with ui.element("div").classes("w-full relative-position"):
            self.chart = ui.echart({"series": []}).classes("w-full").mark("strips")
            self.dots = Dots().mark("dots")
        ui.add_body_html(f"<script>{MOMENT_JS}</script>")
        self.chart.on("chart:finished", js_handler=CHART_JS % (self.chart.id, self.dots.id))
        self.chart.set_visibility(False)

    def draw(self, drawn: list[Strip], end_s: float, name: LightName) -> None:
        """Draw strips up to a time.

        Parameters
        ----------
        name
            Function that returns the name of a light
        """
        if any(strip.dots for strip in (*self.strips, *drawn)):
            self.dots.run_method("show", dot_fields(drawn, name))
        self.strips = drawn
        self.chart.set_visibility(bool(drawn))
        self.chart.style(f"height: {len(drawn) * STRIP_PX + AXIS_PX}px")
        self.chart.options.clear()
        self.chart.options.update(options(drawn, end_s) if drawn else {"series": []})
        self.chart.update()

    def set_moment(self, t_s: float) -> None:
        """Move the line of the shown moment when the next frame is drawn."""
        if self.strips:
            self.contents.set(self.chart.id, {"moment": f"{t_s:.4f}"})


def dot_fields(drawn: list[Strip], name: LightName) -> Record:
    """Data for strips.js: dots, names of their lights, and the place of their strip."""
    n = next((n for n, strip in enumerate(drawn) if strip.dots), 0)
    dots = drawn[n].dots if drawn else []
    names = {int(id): name(int(id)) for _, _, id in dots}
    place = {
        "left": LEFT_PX,
        "right": RIGHT_PX,
        "top": n * STRIP_PX + HEAD_PX,
        "height": INNER_PX,
    }
    return {"dots": dots, "names": names, "grid": n, "place": place, "color": CURVE_COLORS[0]}


def options(drawn: list[Strip], end_s: float) -> Record:
    """ECharts options of stacked strips; each has a title with its unit and a legend."""
    text = {":color": chart_color("quiet"), "fontSize": 11}
    title_text = {":color": chart_color("text"), "fontWeight": "normal", "fontSize": 12}
    title = {"padding": 0, "left": 0, "textStyle": title_text}
    legend = {
        "textStyle": text,
        "itemWidth": 14,
        "itemHeight": 7,
        "itemGap": 10,
        "right": 10,
        "padding": 0,
    }
    grid = {"left": LEFT_PX, "right": RIGHT_PX, "height": INNER_PX}
    x_axis = {"type": "value", "min": 0, "max": round(end_s, 3), "splitLine": {"show": False}}
    found: dict[str, list[Record]] = {
        name: [] for name in ("title", "legend", "grid", "xAxis", "yAxis", "series")
    }
    for n, strip in enumerate(drawn):
        top = n * STRIP_PX
        label = text | {"show": n == len(drawn) - 1, "formatter": "{value} s"}
        names = [curve.name for curve in strip.drawn]
        found["title"].append(title | {"text": strip.title, "top": top + 3})
        found["legend"].append(legend | {"top": top + 3, "data": names})
        found["grid"].append(grid | {"top": top + HEAD_PX})
        found["xAxis"].append(x_axis | {"gridIndex": n, "axisLabel": label, "axisTick": RULE})
        found["yAxis"].append(y_axis(strip, n) | {"axisLabel": text, "splitLine": RULE})
        found["series"] += [series(curve, n, k) for k, curve in enumerate(strip.drawn)]
    return found | {
        "animation": False,
        "tooltip": TOOLTIP,
        "axisPointer": {
            "link": [{"xAxisIndex": "all"}],
            "lineStyle": {":color": chart_color("text")},
        },
        "dataZoom": [ZOOM],
    }


def y_axis(strip: Strip, n: int) -> Record:
    axis = {"gridIndex": n, "splitNumber": 3, "type": "log" if strip.logarithmic else "value"}
    if strip.dots:
        # The next greater of 1, 2, 5, 10 times a power of ten.
        most = max(dot[1] for dot in strip.dots)
        decade = 10.0 ** math.floor(math.log10(max(most, 1e-6)))
        end = next(step * decade for step in (1, 2, 5, 10) if step * decade >= most)
        return axis | {"min": 0, "max": float(f"{end:.6g}")}
    if strip.logarithmic:
        # Whole decades that contain the values, at most the uppermost four.
        values = [y for curve in strip.drawn for _, y in curve.points if y > 0] or [1.0]
        low = math.floor(math.log10(min(values)))
        high = math.ceil(math.log10(max(values)))
        return axis | {"min": 10.0 ** max(low, high - 4), "max": 10.0 ** max(high, low + 1)}
    return axis


def series(curve: StripCurve, n: int, k: int) -> Record:
    """ECharts series of a curve in strip n. A band's area reaches to the axis, so that two make one around zero."""
    is_band = curve.kind == "band"
    is_dots = curve.kind == "dots"
    color = BAND_COLOR if is_band else CURVE_COLORS[k % len(CURVE_COLORS)]
    look = {"areaStyle": {"color": color, "opacity": 0.22}} if is_band else {"symbolSize": 5}
    return look | {
        "name": curve.name,
        "type": "scatter" if is_dots else "line",
        "data": curve.points,
        "animation": False,
        "showSymbol": is_dots,
        "itemStyle": {"color": color},
        "lineStyle": {"width": 0.8 if is_band else 1.5, "color": color},
        "xAxisIndex": n,
        "yAxisIndex": n,
    }


def rms_line(rows: Sequence[FlightRow]) -> str:
    """Root mean squares over the flight's solved frames, and how many were solved, and wrong."""
    solved = [one.row for one in rows if one.row.estimate_deg]
    if not solved:
        return f"{len(rows)} frames, none solved" if rows else ""
    errors = [(row.cross_arcsec, row.roll_arcsec) for row in solved]
    cross, roll = np.sqrt(np.mean(np.square(errors), axis=0))
    wrong = sum(row.wrong for row in solved)
    return f"{len(solved)} of {len(rows)} frames solved, {wrong} wrong; rms: cross {cross:.3g}″, roll {roll:.3g}″"
