// Map of coverage: for many directions of the boresight what the tracker makes of a frame there, and how many lights it
// has. A click on a mark, or Enter, moves the camera there. The marks are also drawn on the dome of the 3-D view.
const R = 150, MARK = 11; // radius of the map and of a mark, in units of the picture
const STATES = {
  solved: { color: "good", path: `M-${MARK} 0a${MARK} ${MARK} 0 1 0 ${2 * MARK} 0a${MARK} ${MARK} 0 1 0 -${2 * MARK} 0` },
  ambiguous: { color: "accent", path: `M0 -${MARK + 3}L${MARK + 3} 0L0 ${MARK + 3}L-${MARK + 3} 0Z` },
  refused: { color: "warn", path: `M-${MARK} -${MARK}H${MARK}V${MARK}H-${MARK}Z` },
  wrong: { color: "bad", path: `M0 -${MARK + 4}L${MARK + 3} ${MARK}H-${MARK + 3}Z` },
};
const EMPTY = "Coverage solves a frame at each of many attitudes in reach; a click on the map moves the camera there.";
const RINGS_DEG = [2, 5, 10, 15, 30, 45, 60];
const polar = ([x, y, z]) => Math.acos(Math.max(-1, Math.min(1, z / Math.hypot(x, y, z))));

export default {
  template: `
    <div class="lab-coverage">
      <p class="quiet">{{ text }}</p>
      <svg v-if="total" :viewBox="box" role="group" aria-label="Map of coverage">
        <g v-for="ring in rings" class="ring"><circle :r="ring.r"></circle><text :x="ring.x" :y="ring.y">{{ ring.label }}</text></g>
        <g v-for="(one, n) in marks" :key="n" role="button" tabindex="0" :aria-label="one.title" :class="one.state"
          :transform="one.move" @click="$emit('point', n)" @keydown.enter="$emit('point', n)">
          <title>{{ one.title }}</title><path :d="one.path" :style="one.style"></path><text y="4">{{ one.lights }}</text>
        </g>
      </svg>
      <p v-if="total" class="legend"><span v-for="one in legend"><svg viewBox="-16 -16 32 32"><path :d="one.path"
        :style="one.style"></path></svg>{{ one.name }} {{ one.count }}</span></p>
    </div>`,
  data: () => ({ text: EMPTY, total: 0, rings: [], marks: [], places: [] }),
  computed: {
    box: () => `${-R - 16} ${-R - 18} ${2 * R + 32} ${2 * R + 36}`,
    legend() {
      return Object.keys(STATES).map((name) => ({ ...this.look(name), name, count: this.marks.filter((one) => one.state === name).length }));
    },
  },
  methods: {
    look(name) {
      const { color, path } = STATES[name], css = `var(--lab-${color})`;
      return { path, style: { stroke: css, fill: css } };
    },
    // The place on a ring that is farthest from all marks: there its label is read.
    free(r) {
      const found = Array.from({ length: 48 }, (_, n) => {
        const azimuth = (n * Math.PI) / 24 - Math.PI / 2, x = r * Math.cos(azimuth), y = r * Math.sin(azimuth);
        return { x, y: y + 3, away: Math.min(...this.places.map(([mx, my]) => Math.hypot(x - mx, y - my))) };
      });
      return found.reduce((best, one) => (one.away > best.away + 0.5 ? one : best));
    },
    // A new map, or none. directions: of the boresights, z in the middle of the map
    begin(directions, isSky) {
      const most = Math.max(...directions.map(polar), 0.02), degree = Math.PI / 180;
      const step = RINGS_DEG.find((ring) => most / degree / ring < 4.5) ?? 60;
      const labels = Array.from({ length: Math.floor(most / degree / step + 1e-6) }, (_, n) => (n + 1) * step);
      this.places = directions.map((at) => {
        const away = (polar(at) * R) / most, azimuth = Math.atan2(at[1], at[0]);
        return [away * Math.cos(azimuth), -away * Math.sin(azimuth)];
      });
      this.rings = labels.map((ring) => {
        const r = (ring * degree * R) / most;
        return { r, ...this.free(r), label: isSky ? `Dec ${90 - ring}°` : `${ring}°` };
      });
      this.directions = directions;
      this.view = isSky ? "North is in the middle, RA 0° on the right." : "As seen from above, the lab's x axis to the right.";
      const text = directions.length ? `0 of ${directions.length} attitudes` : EMPTY;
      Object.assign(this, { marks: [], total: directions.length, text });
      this.draw();
    },
    // The next attitude: its angles, the counts of lights in the field, detected and identified, the tracker's status, and
    // whether its attitude is wrong.
    add(angles, lights, detected, matched, status, isWrong) {
      const [x, y] = this.places[this.marks.length];
      const name = status.startsWith("ambiguous") ? "ambiguous" : status === "solved" ? "solved" : "refused";
      const state = isWrong ? "wrong" : name, at = angles.map((angle) => `${angle.toFixed(1)}°`).join(" ");
      const title = `${at}: ${lights} lights, ${detected} detected, ${matched} identified; ${isWrong ? "wrong" : status}`;
      this.marks.push({ ...this.look(state), state, title, lights, move: `translate(${x.toFixed(1)} ${y.toFixed(1)})` });
      const counts = this.marks.map((one) => one.lights), range = `${Math.min(...counts)} to ${Math.max(...counts)}`;
      this.text = `${this.marks.length} of ${this.total} attitudes, ${range} lights in the field. ${this.view}`;
      this.draw();
    },
    draw() {
      const style = getComputedStyle(document.body), colors = ({ state }) => style.getPropertyValue(`--lab-${STATES[state].color}`).trim();
      const dots = this.marks.map((one, n) => [this.directions[n], colors(one)]);
      window.dispatchEvent(new CustomEvent("skysim-coverage", { detail: { dots } }));
    },
  },
};
