// Strip charts of a flight: curves against a common time axis, one chart above the other, with a line at the shown moment.
// A click on a strip emits `moment` with the time there. Curves of a kept flight, the reference, are drawn over them.
// Dots, over the chart: one for each identified light and frame. A light whose dot is hovered lights up in the other views,
// and the dots of a light that is hovered there are larger.
import { echarts } from "nicegui-echart";

const STRIP_PX = 118, HEAD_PX = 22, AXIS_PX = 24; // heights of a strip, of its title and legend, of the time axis
const INNER_PX = STRIP_PX - HEAD_PX - 8; // height of a strip between its axes
const LEFT_PX = 52, RIGHT_PX = 12; // as the timeline
const REACH_PX = 7, FONT_PX = 11;
const BAND_COLOR = "#8b95a5", REFERENCE = "reference";
const ZOOM = { type: "inside", xAxisIndex: "all", zoomOnMouseWheel: "ctrl", moveOnMouseMove: "shift",
  moveOnMouseWheel: false, filterMode: "none" };

const theme = (name) => getComputedStyle(document.body).getPropertyValue(`--lab-${name}`).trim();
const placeOf = (n) => ({ left: LEFT_PX, right: RIGHT_PX, top: n * STRIP_PX + HEAD_PX, height: INNER_PX });

// A strip with the reference's curve over it: its last line, or else its dots. One curve, so that its color tells the flight.
function withReference(strip, kept) {
  const curves = strip.curves.filter(({ points }) => points.length);
  const own = kept.find(({ title }) => title === strip.title)?.curves.filter(({ points }) => points.length) ?? [];
  const over = own.findLast(({ kind }) => kind === "line") ?? own.find(({ kind }) => kind === "dots");
  return { ...strip, curves: over ? [...curves, { ...over, name: REFERENCE }] : curves };
}

// Of dots from zero to the next greater of 1, 2, 5, 10 times a power of ten; of a logarithmic strip, whole decades that
// contain the values, at most the uppermost four.
function rangeOf({ curves, dots, logarithmic }) {
  if (dots.length) {
    const most = dots.reduce((greatest, dot) => Math.max(greatest, dot[1]), 1e-6), decade = 10 ** Math.floor(Math.log10(most));
    return { min: 0, max: Number(([1, 2, 5, 10].find((step) => step * decade >= most) * decade).toPrecision(6)) };
  }
  if (!logarithmic) return {};
  const values = curves.flatMap(({ points }) => points.map((point) => point[1])).filter((value) => value > 0);
  const [least, most] = values.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, 0]);
  const low = Math.floor(Math.log10(values.length ? least : 1)), high = Math.ceil(Math.log10(values.length ? most : 1));
  return { min: 10 ** Math.max(low, high - 4), max: 10 ** Math.max(high, low + 1) };
}

// A band's area reaches to the axis, so that two make one around zero.
function seriesOf({ name, points, kind }, n, color) {
  const isBand = kind === "band", isDots = kind === "dots", isReference = name === REFERENCE;
  return { name, type: isDots ? "scatter" : "line", data: points, animation: false, showSymbol: isDots,
    symbol: isReference ? "diamond" : "circle", symbolSize: isReference ? 8 : 5, z: isReference ? 1 : 2,
    itemStyle: isReference ? { color: "transparent", borderColor: color, borderWidth: 1.3 } : { color },
    lineStyle: { width: isBand ? 0.8 : 1.5, color, type: isReference ? "dashed" : "solid" },
    ...(isBand && { areaStyle: { color, opacity: 0.22 } }), xAxisIndex: n, yAxisIndex: n };
}

function optionsOf(strips, end, colors) {
  const text = { color: theme("quiet"), fontSize: 11 }, rule = { lineStyle: { color: theme("line") } };
  const colorOf = ({ name, kind }, k) => {
    if (name === REFERENCE) return theme("text");
    return kind === "band" ? BAND_COLOR : colors[k % colors.length];
  };
  return {
    title: strips.map(({ title }, n) => ({ text: title, top: n * STRIP_PX + 3, padding: 0, left: 0,
      textStyle: { color: theme("text"), fontWeight: "normal", fontSize: 12 } })),
    legend: strips.map(({ curves }, n) => ({ data: curves.map(({ name }) => name), top: n * STRIP_PX + 3, right: RIGHT_PX + 6, padding: 0,
      textStyle: text, itemWidth: 14, itemHeight: 7, itemGap: 10 })),
    grid: strips.map((_, n) => placeOf(n)),
    xAxis: strips.map((_, n) => ({ gridIndex: n, type: "value", min: 0, max: Number(end.toFixed(3)), splitLine: { show: false },
      axisLabel: { ...text, show: n === strips.length - 1, formatter: "{value} s" }, axisTick: rule })),
    yAxis: strips.map((strip, n) => ({ gridIndex: n, splitNumber: 3, type: strip.logarithmic ? "log" : "value",
      axisLabel: text, splitLine: rule, ...rangeOf(strip) })),
    series: strips.flatMap(({ curves }, n) => curves.map((curve, k) => seriesOf(curve, n, colorOf(curve, k)))),
    animation: false,
    tooltip: { trigger: "axis", confine: true, backgroundColor: theme("panel"), borderWidth: 1, borderColor: theme("line"),
      textStyle: { color: theme("text"), fontSize: 11 } },
    axisPointer: { link: [{ xAxisIndex: "all" }], lineStyle: { color: theme("text") } },
    dataZoom: [ZOOM],
  };
}

export default {
  template: `<div class="lab-strips"><div ref="chart" class="nicegui-echart"></div><canvas ref="dots" class="lab-dots"></canvas>
    <div ref="moment" class="lab-moment" hidden></div></div>`,
  props: { colors: Array },
  created() {
    // Not reactive: Vue must not watch thousands of dots. grid: the strip of the dots; hovered: here; ringed: here or elsewhere
    Object.assign(this, { chart: null, strips: [], end: 1, dots: [], names: {}, grid: 0, hovered: null, ringed: null, moment: 0 });
  },
  mounted() {
    window.addEventListener("skysim-hover", this.ring);
    window.skysimMoment = this.setMoment;
    this.resized = new ResizeObserver(() => this.chart?.resize());
    this.resized.observe(this.$refs.chart);
    this.themed = new MutationObserver(this.draw); // its colors are the theme's
    this.themed.observe(document.body, { attributeFilter: ["class"] });
  },
  beforeUnmount() {
    window.removeEventListener("skysim-hover", this.ring);
    this.resized.disconnect();
    this.themed.disconnect();
    this.chart?.dispose();
  },
  methods: {
    // From the server: strips: { title, curves: [{ name, points, kind }], logarithmic, dots: [time, value, number] each };
    // kept: the reference's; end: of the time axis; names of the dots' lights by number
    show(strips, kept, end, names) {
      const grid = Math.max(strips.findIndex(({ dots }) => dots.length), 0), dots = strips[grid]?.dots ?? [];
      Object.assign(this, { strips: strips.map((strip) => withReference(strip, kept)), end, names, grid, dots });
      this.draw();
    },
    draw() {
      const { strips, end, colors } = this, box = this.$refs.chart;
      this.$el.hidden = !strips.length;
      box.style.height = `${strips.length * STRIP_PX + AXIS_PX}px`;
      if (strips.length) {
        this.chart ??= this.begin(box);
        const options = optionsOf(strips, end, colors), before = this.chart.getOption();
        const isAlike = ["grid", "series"].every((part) => before?.[part]?.length === options[part].length);
        this.chart.setOption(options, { notMerge: !isAlike }); // where it is alike the zoom is kept
        this.chart.resize();
      }
      this.paint();
    },
    begin(box) {
      const chart = echarts.init(box), surface = chart.getZr();
      chart.on("finished", () => {
        this.setMoment(this.moment);
        this.paint();
      });
      surface.on("mousemove", ({ offsetX, offsetY }) => this.hover(this.nearest(offsetX, offsetY)));
      surface.on("globalout", () => this.hover(null));
      surface.on("click", ({ offsetX, offsetY }) => {
        const at = [offsetX, offsetY], gridIndex = this.strips.findIndex((_, n) => chart.containPixel({ gridIndex: n }, at));
        if (gridIndex >= 0) this.$emit("moment", chart.convertFromPixel({ gridIndex }, at)[0]);
      });
      return chart;
    },
    // The line of the shown moment is a separate element, because the chart would draw all curves again for it.
    setMoment(moment) {
      this.moment = moment;
      const { chart, strips } = this, line = this.$refs.moment;
      const x = chart && strips.length ? chart.convertToPixel({ xAxisIndex: 0 }, moment) : NaN;
      line.hidden = !(x >= LEFT_PX && x <= chart?.getWidth() - RIGHT_PX);
      line.style.transform = `translateX(${x}px)`;
    },
    // The place of a dot: both axes are linear.
    scale() {
      const { chart, grid } = this, finder = { gridIndex: grid };
      const from = chart.convertToPixel(finder, [0, 0]), to = chart.convertToPixel(finder, [1, 1]);
      // The chart may have lost this strip already, as after a worker's end: then no dot has a place.
      if (!from || !to) return () => [NaN, NaN];
      return ([t, y]) => [from[0] + t * (to[0] - from[0]), from[1] + y * (to[1] - from[1])];
    },
    paint() {
      const canvas = this.$refs.dots, { dots, grid, chart } = this;
      Object.assign(canvas.dataset, { dots: dots.length, ringed: this.ringed ?? "" });
      if (!chart) return;
      const [width, height] = [chart.getWidth(), chart.getHeight()], pen = canvas.getContext("2d"), place = placeOf(grid);
      [canvas.width, canvas.height] = [width * devicePixelRatio, height * devicePixelRatio];
      Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
      if (!dots.length || !width) return;
      pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
      pen.save();
      pen.rect(place.left, place.top - 3, width - place.left - place.right, place.height + 6);
      pen.clip();
      const at = this.scale(), draw = (dot, size) => {
        const [x, y] = at(dot);
        pen.fillRect(x - size / 2, y - size / 2, size, size);
      };
      pen.fillStyle = this.colors[0];
      pen.globalAlpha = this.ringed === null ? 0.8 : 0.5;
      for (const dot of dots) draw(dot, 2.5);
      pen.globalAlpha = 1;
      const own = dots.filter((dot) => dot[2] === this.ringed);
      pen.fillStyle = theme("warn");
      for (const dot of own) draw(dot, 6);
      pen.restore();
      if (own.length) this.write(pen, own, this.names[this.ringed], width - place.right, place.top);
    },
    // The light's name and the rms of its residuals, over the strip.
    write(pen, own, name, right, top) {
      const rms = Math.sqrt(own.reduce((sum, [, value]) => sum + value ** 2, 0) / own.length);
      pen.font = `${FONT_PX}px ui-monospace, monospace`;
      pen.textAlign = "right";
      pen.fillStyle = theme("warn");
      pen.fillText(`${name}: rms ${rms.toPrecision(3)} px`, right, top - 8);
    },
    nearest(x, y) {
      const { dots, grid } = this, { top, height } = placeOf(grid);
      if (!dots.length || y < top - REACH_PX || y > top + height + REACH_PX) return null;
      const at = this.scale();
      let best = null, least = REACH_PX;
      for (const dot of dots) {
        const [left, above] = at(dot), distance = Math.hypot(left - x, above - y);
        if (distance < least) [best, least] = [dot[2], distance];
      }
      return best;
    },
    hover(id) {
      if (id === this.hovered) return;
      this.hovered = id;
      window.dispatchEvent(new CustomEvent("skysim-hover", { detail: { id } }));
    },
    ring({ detail: { id } }) {
      if (id === this.ringed) return;
      this.ringed = id;
      if (this.dots.length) this.paint();
    },
  },
};
