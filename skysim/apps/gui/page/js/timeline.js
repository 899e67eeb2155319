// Timeline of a flight: a lane for each kind of event. A click on an event, or Enter, shows its frame.
const LEFT_PX = 52, RIGHT_PX = 12; // as the strips
const COLORS = { wrong: "bad", refused: "warn", saturated: "accent" };

export default {
  template: `
    <div v-if="lanes.length" class="lab-timeline" role="list" aria-label="Events of the flight">
      <div v-for="lane in lanes" :key="lane.name" class="lane" role="listitem" :aria-label="lane.name + ': ' + lane.count">
        <button v-for="event in lane.events" :style="event.style" :title="event.text" :aria-label="event.text"
          @click="$emit('moment', event.at)"></button>
        <span class="quiet">{{ lane.name }} · {{ lane.count }}</span>
      </div>
    </div>`,
  data: () => ({ lanes: [] }),
  methods: {
    // frames: [time, status, whether wrong, saturated pixels, answer of the filter] each;  limits: [name, from, to] each;
    // end: of the flight
    show(frames, limits, end) {
      const lanes = new Map();
      const add = (name, from, to, text, color) => {
        const at = (time) => `calc(${LEFT_PX}px + (100% - ${LEFT_PX + RIGHT_PX}px) * ${Math.min(time / end, 1)})`;
        const style = { left: at(from), width: `calc((100% - ${LEFT_PX + RIGHT_PX}px) * ${(to - from) / end})` };
        style.background = `var(--lab-${color})`;
        if (!lanes.has(name)) lanes.set(name, { name, count: 0, events: [] });
        const lane = lanes.get(name);
        lane.count += 1;
        lane.events.push({ at: from, text: `${from.toFixed(2)} s: ${text}`, style });
      };
      for (const [t, status, isWrong, saturated, filter] of frames) {
        if (isWrong) add("wrong", t, t, "wrong attitude", COLORS.wrong);
        if (status !== "solved") add("refused", t, t, `refused: ${status}`, COLORS.refused);
        // Without a solution the filter repeats the tracker's reason.
        if (status === "solved" && filter && filter !== "used") add("filter", t, t, `the filter ${filter}`, COLORS.refused);
        if (saturated) add("saturated", t, t, `${saturated} pixels saturated`, COLORS.saturated);
      }
      for (const [name, from, to] of limits) add(name, from, to, `${name} until ${to.toFixed(2)} s`, "warn");
      this.lanes = [...lanes.values()];
    },
  },
};
