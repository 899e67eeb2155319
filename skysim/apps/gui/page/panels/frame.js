// A frame and its marks on one canvas. The frame is decoded off the main thread and drawn together with its marks, so
// that marks never appear on another frame. An <img> below an <svg> took the browser twice as long.
export default {
  template: `<canvas role="img" @click="reportMouse" @mousemove="reportMouse" @mouseleave="reportMouse"></canvas>`,
  props: { view: Object }, // src: the frame's address; size: of the frame; marks: see overlay.py; label: in words
  mounted() {
    this.drawn = null; // a view and its bitmap
    this.fetching = false;
    this.pen = this.$el.getContext("2d", { alpha: false });
    this.watcher = new ResizeObserver(() => this.paint());
    this.watcher.observe(this.$el);
    this.draw();
  },
  beforeUnmount() {
    this.watcher.disconnect();
  },
  watch: {
    view() {
      this.draw();
    },
  },
  methods: {
    // Draw the newest view. If a newer one arrives while a frame is fetched, draw the fetched one first, then the newer.
    async draw() {
      if (this.fetching) return;
      this.fetching = true;
      try {
        while (this.view && this.view !== this.drawn?.view) {
          const view = this.view;
          const bitmap = view.src === this.drawn?.view.src ? this.drawn.bitmap : await this.fetchFrame(view.src);
          if (!bitmap && view === this.view) break;
          if (!bitmap) continue;
          if (this.drawn && this.drawn.bitmap !== bitmap) this.drawn.bitmap.close();
          this.drawn = { view, bitmap };
          this.paint();
          this.$emit("drawn", { src: view.src });
        }
      } finally {
        this.fetching = false;
      }
    },
    // Fetch and decode a frame; null if the server is unreachable or holds only newer frames, which it will announce.
    async fetchFrame(src) {
      try {
        const response = await fetch((window.path_prefix || "") + src);
        return response.ok ? await createImageBitmap(await response.blob()) : null;
      } catch {
        return null;
      }
    },
    // The canvas has the resolution of the screen, so that a frame is scaled only once.
    paint() {
      const canvas = this.$el, pen = this.pen;
      const wide = Math.round(canvas.clientWidth * devicePixelRatio);
      const high = Math.round(canvas.clientHeight * devicePixelRatio);
      if (!this.drawn || !wide || !high) return;
      const { view, bitmap } = this.drawn;
      if (canvas.width !== wide || canvas.height !== high) {
        [canvas.width, canvas.height] = [wide, high];
        this.$emit("sized", { wide }); // the server need not send wider images
      }
      pen.resetTransform();
      pen.imageSmoothingEnabled = wide < bitmap.width; // enlarged frames show their pixels
      pen.drawImage(bitmap, 0, 0, wide, high);
      pen.scale(wide / view.size[0], high / view.size[1]);
      for (const mark of view.marks) {
        pen.strokeStyle = pen.fillStyle = mark.color;
        pen.lineWidth = mark.width;
        pen.setLineDash(mark.dash);
        pen.stroke(new Path2D(mark.path));
        pen.font = `${mark.font}px ui-monospace, monospace`;
        for (const [x, y, name] of mark.names) { // dark background, readable over a bright sky
          pen.fillStyle = "rgb(13 16 21 / 65%)";
          pen.fillRect(x, y - 0.8 * mark.font, 0.61 * mark.font * name.length, mark.font);
          pen.fillStyle = mark.color;
          pen.fillText(name, x, y);
        }
      }
      canvas.dataset.frame = view.src;
      canvas.ariaLabel = view.label;
    },
    // Report the mouse position in frame pixels from the frame's corner.
    reportMouse(event) {
      if (!this.drawn) return;
      const { clientWidth, clientHeight } = this.$el, [wide, high] = this.drawn.view.size;
      const x = (event.offsetX * wide) / clientWidth, y = (event.offsetY * high) / clientHeight;
      this.$emit("mouse", { kind: event.type, x, y });
    },
  },
};
