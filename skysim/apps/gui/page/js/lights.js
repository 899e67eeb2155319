import { brief } from "skysim-views/plots.js";

const fixed = (digits) => (value) => value.toFixed(digits);
const COLUMNS = {
  light: String, V: fixed(2), "e⁻": brief, "peak, e⁻": brief, "of full well": (share) => `${(100 * share).toFixed(0)} %`,
  "x, px": fixed(1), "y, px": fixed(1), "error, px": fixed(3), "taken for": String,
};
const FORMATS = Object.values(COLUMNS);
const text = (value, n) => (typeof value === "number" ? FORMATS[n](value) : value ?? "");

// Table of the lights on the frame. A hovered row lights up in the other views, and a light hovered there in the table.
export default {
  template: `
    <table class="lab-lights mono">
      <thead><tr><th v-for="head in heads">{{ head }}</th></tr></thead>
      <tbody @pointerleave="hover(null)">
        <tr v-for="row in rows" :key="row.key" :class="{ ringed: row.id === ringed && row.id >= 0, [row.state]: true }"
          :data-id="row.id" @pointerenter="hover(row.id)"><td v-for="cell in row.cells">{{ cell }}</td></tr>
      </tbody>
    </table>`,
  data: () => ({ heads: Object.keys(COLUMNS), rows: [], ringed: null }),
  mounted() {
    window.addEventListener("skysim-hover", this.ring);
  },
  beforeUnmount() {
    window.removeEventListener("skysim-hover", this.ring);
  },
  methods: {
    // rows: { key, id: number or -1, state, cells: numbers, texts or null }
    show(rows) {
      this.rows = rows.map((row) => ({ ...row, cells: row.cells.map(text) }));
    },
    hover(id) {
      window.dispatchEvent(new CustomEvent("skysim-hover", { detail: { id: id >= 0 ? id : null } }));
    },
    ring({ detail: { id } }) {
      this.ringed = id;
      if (id !== null) this.$el.querySelector(`tr[data-id="${id}"]:not(:hover)`)?.scrollIntoView({ block: "nearest" });
    },
  },
};
