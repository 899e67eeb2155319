// An element whose content arrives with the frames, see live.js. tag: "div" or "input"
import { attach, detach } from "skysim-views/live.js";

export default {
  template: `<component :is="tag" :type="type || null"></component>`,
  props: { number: Number, tag: String, type: String },
  mounted() {
    attach(this.number, this.$el);
  },
  updated() {
    attach(this.number, this.$el); // another greatest value of a slider, for example
  },
  unmounted() {
    detach(this.number);
  },
  methods: {
    focus() {
      this.$el.focus();
      this.$el.select?.();
    },
    blur() {
      this.$el.blur();
    },
  },
};
