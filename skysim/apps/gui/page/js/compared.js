// How a flight differs from the one that is kept as the reference: both names and commands, and a sentence on their errors.
const number = (value) => {
  if (value === null) return "–"; // no frame is solved
  return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4)));
};

export default {
  template: `
    <div v-if="kept" class="lab-compared">
      <div class="mono" data-run="own">{{ own.command }}</div>
      <div class="mono" data-run="reference">{{ kept.command }}</div>
      <div data-run="sentence">{{ sentence }}</div>
      <div class="row q-gutter-xs">
        <q-btn dense outline no-caps color="primary" size="sm" label="Other flight's frame" :disable="!own.run" @click="$emit('switch')" />
        <q-btn dense outline no-caps color="primary" size="sm" :label="copied ? 'Copied' : 'Copy both commands'" @click="copy" />
        <q-btn dense flat no-caps color="primary" size="sm" label="Forget the reference" @click="$emit('forget')" />
      </div>
    </div>`,
  data: () => ({ own: {}, kept: null, pairs: 0, copied: false }),
  computed: {
    sentence() {
      const { own, kept } = this;
      if (!own.run) return `${kept.name} is kept as the reference. Simulate another flight.`;
      const against = (unit, of) => `${number(of(own.run))}${unit} against ${number(of(kept.run))}${unit}`;
      return `Median cross error ${against("″", (run) => run.cross_arcsec_median)}, roll ${against("″", (run) => run.roll_arcsec_median)}` +
        ` (reference: ${kept.name}). Frames solved ${against("", (run) => run.solved)}, wrong ${against("", (run) => run.wrong)},` +
        ` refused ${against("", (run) => run.frames - run.solved)}.${this.pairs ? "" : " No frames of both have the same time."}`;
    },
  },
  methods: {
    // own, kept: { name, command, run: what `skysim run --json` prints of it, null before it is flown }; no arguments: no reference
    // pairs: number of frames that have the same time as one of the reference
    show(own = {}, kept = null, pairs = 0) {
      Object.assign(this, { own, kept, pairs, copied: false });
    },
    // Where the browser gives no clipboard, as to a page of another machine without https, the commands are selected.
    async copy() {
      const lines = this.$el.querySelectorAll("[data-run=own], [data-run=reference]");
      try {
        await navigator.clipboard.writeText(`${this.own.command}\n${this.kept.command}\n`);
        this.copied = true;
      } catch {
        getSelection().setBaseAndExtent(lines[0], 0, lines[1], 1);
      }
    },
  },
};
