// Dots over a strip of the chart: one for each identified light and frame. A light whose dot is hovered lights up in the
// other views, and the dots of a light that is hovered there are larger.
const REACH_PX = 7, FONT_PX = 11;

export default {
  template: `<canvas class="lab-dots"></canvas>`,
  created() {
    // Not reactive: Vue must not watch thousands of dots. hovered: here; ringed: here or elsewhere
    Object.assign(this, { chart: null, shown: { dots: [], names: {} }, hovered: null, ringed: null });
  },
  mounted() {
    window.addEventListener("skysim-hover", this.ring);
  },
  beforeUnmount() {
    window.removeEventListener("skysim-hover", this.ring);
  },
  methods: {
    // From the server: dots: [time, value, number] each; names by number; grid, place: of their strip; color.
    show(shown) {
      this.shown = shown;
      this.paint();
    },
    // The chart has been drawn.
    attach(chart) {
      if (chart !== this.chart) {
        this.chart = chart;
        chart.getZr().on("mousemove", ({ offsetX, offsetY }) => this.hover(this.nearest(offsetX, offsetY)));
        chart.getZr().on("globalout", () => this.hover(null));
      }
      this.paint();
    },
    // The place of a dot: both axes are linear.
    scale() {
      const { chart, shown } = this, finder = { gridIndex: shown.grid };
      const from = chart.convertToPixel(finder, [0, 0]), to = chart.convertToPixel(finder, [1, 1]);
      // The chart may have lost this strip already, as after a worker's end: then no dot has a place.
      if (!from || !to) return () => [NaN, NaN];
      return ([t, y]) => [from[0] + t * (to[0] - from[0]), from[1] + y * (to[1] - from[1])];
    },
    paint() {
      const canvas = this.$el, { dots, names, place, color } = this.shown;
      Object.assign(canvas.dataset, { dots: dots.length, ringed: this.ringed ?? "" });
      if (!this.chart || this.chart.isDisposed()) return;
      const [width, height] = [this.chart.getWidth(), this.chart.getHeight()], pen = canvas.getContext("2d");
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
      pen.fillStyle = color;
      pen.globalAlpha = this.ringed === null ? 0.8 : 0.5;
      for (const dot of dots) draw(dot, 2.5);
      pen.globalAlpha = 1;
      const own = dots.filter((dot) => dot[2] === this.ringed);
      pen.fillStyle = getComputedStyle(document.body).getPropertyValue("--lab-warn");
      for (const dot of own) draw(dot, 6);
      pen.restore();
      if (own.length) this.write(pen, own, names[this.ringed], width - place.right);
    },
    // The light's name and the rms of its residuals, over the strip.
    write(pen, own, name, right) {
      const rms = Math.sqrt(own.reduce((sum, [, value]) => sum + value ** 2, 0) / own.length);
      pen.font = `${FONT_PX}px ui-monospace, monospace`;
      pen.textAlign = "right";
      pen.fillStyle = getComputedStyle(document.body).getPropertyValue("--lab-warn");
      pen.fillText(`${name}: rms ${rms.toPrecision(3)} px`, right, this.shown.place.top - 8);
    },
    nearest(x, y) {
      const { dots, place } = this.shown;
      if (!dots.length || y < place.top - REACH_PX || y > place.top + place.height + REACH_PX) return null;
      const at = this.scale();
      let best = null, least = REACH_PX;
      for (const dot of dots) {
        const [left, top] = at(dot), distance = Math.hypot(left - x, top - y);
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
      if (this.shown.dots.length) this.paint();
    },
  },
};
