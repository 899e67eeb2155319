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
  data: () => ({ heads: [], rows: [], ringed: null }),
  mounted() {
    window.addEventListener("skysim-hover", this.ring);
  },
  beforeUnmount() {
    window.removeEventListener("skysim-hover", this.ring);
  },
  methods: {
    // rows: { key, id: number or -1, state, cells }
    show(heads, rows) {
      Object.assign(this, { heads, rows });
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
