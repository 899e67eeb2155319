// Means of each light's residuals over a flight: a table, worst first, and arrows in the view of the laboratory.
import { arrowScale } from "skysim-views/marks.js";

const ARROW_RAD = 0.04; // least length of the median arrow, as an angle seen from the middle of the laboratory
const CLEAR = 4; // mean over its standard error from which the mean is no chance

export default {
  template: `
    <div v-if="rows.length" class="lab-residuals">
      <label><input type="checkbox" v-model="drawn"> residuals in 3-D</label> <span class="quiet">{{ scale }}</span>
      <table class="lab-lights mono">
        <thead><tr><th>light</th><th>frames</th><th>mean, px</th><th>scatter, px</th><th>mean / error</th></tr></thead>
        <tbody @pointerleave="hover(null)">
          <tr v-for="row in rows" :key="row.id" :class="{ ringed: row.id === ringed, [row.state]: true }"
            @pointerenter="hover(row.id)"><td v-for="cell in row.cells">{{ cell }}</td></tr>
        </tbody>
      </table>
    </div>`,
  data: () => ({ rows: [], drawn: false, scale: "", ringed: null }),
  mounted() {
    window.addEventListener("skysim-hover", this.ring);
  },
  beforeUnmount() {
    window.removeEventListener("skysim-hover", this.ring);
  },
  watch: {
    drawn() {
      this.draw();
    },
  },
  methods: {
    // Columns by light: numbers, frames, means [x, y, z], scatters (null: one frame); the angle of a pixel in arcseconds
    show(ids, frames, means, scatters, prefix, pixel) {
      this.rows = ids.map((id, n) => {
        const mean = Math.hypot(...means[n]), error = scatters[n] / Math.sqrt(frames[n]), ratio = error ? mean / error : 0;
        const scatter = scatters[n] ? [scatters[n].toPrecision(3), ratio.toFixed(1)] : ["–", "–"];
        const cells = [`${prefix} ${id}`, frames[n], mean.toPrecision(3), ...scatter];
        return { id, mean, along: means[n], cells, state: ratio > CLEAR ? "warn" : "quiet" };
      });
      this.pixel = (pixel / 3600) * (Math.PI / 180);
      this.draw();
    },
    draw() {
      const { drawn, rows, pixel } = this, { factor, longest, text } = arrowScale(rows.map(({ mean }) => mean), ARROW_RAD / pixel);
      const vector = ({ mean, along }) => along.map((part) => part * factor * pixel * Math.min(1, longest / mean));
      const arrows = drawn ? rows.map((row) => [row.id, vector(row)]) : [];
      this.scale = arrows.length ? text : "mean of each light over the flight, worst first";
      window.dispatchEvent(new CustomEvent("skysim-arrows", { detail: { arrows } }));
    },
    hover(id) {
      window.dispatchEvent(new CustomEvent("skysim-hover", { detail: { id } }));
    },
    ring({ detail: { id } }) {
      this.ringed = id;
    },
  },
};
