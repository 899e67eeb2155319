// A frame and its marks on one canvas. The frame is decoded off the main thread and drawn together with its marks, so
// that marks never appear on another frame. An <img> below an <svg> took the browser twice as long.
export default {
  template: `<canvas role="img" @click="told" @mousemove="told" @mouseleave="told"></canvas>`,
  props: { look: Object }, // src: the frame's address; size: of the frame; marks: see overlay.py; label: in words
  mounted() {
    this.drawn = null; // a look and its picture
    this.fetching = false;
    this.pen = this.$el.getContext("2d", { alpha: false });
    this.watcher = new ResizeObserver(() => this.paint());
    this.watcher.observe(this.$el);
    this.renew();
  },
  beforeUnmount() {
    this.watcher.disconnect();
  },
  watch: {
    look() {
      this.renew();
    },
  },
  methods: {
    // Draw the newest look. If a newer one arrives while a frame is fetched, draw the fetched one first, then the newer.
    async renew() {
      if (this.fetching) return;
      this.fetching = true;
      try {
        while (this.look && this.look !== this.drawn?.look) {
          const look = this.look;
          const bitmap = look.src === this.drawn?.look.src ? this.drawn.bitmap : await this.fetched(look.src);
          if (!bitmap && look === this.look) break;
          if (!bitmap) continue;
          if (this.drawn && this.drawn.bitmap !== bitmap) this.drawn.bitmap.close();
          this.drawn = { look, bitmap };
          this.paint();
          this.$emit("drawn", { src: look.src });
        }
      } finally {
        this.fetching = false;
      }
    },
    // Fetch and decode a frame; null if the server is unreachable or holds only newer frames, which it will announce.
    async fetched(src) {
      try {
        const answer = await fetch((window.path_prefix || "") + src);
        return answer.ok ? await createImageBitmap(await answer.blob()) : null;
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
      const { look, bitmap } = this.drawn;
      if (canvas.width !== wide || canvas.height !== high) {
        [canvas.width, canvas.height] = [wide, high];
        this.$emit("sized", { wide }); // the server need not send wider images
      }
      pen.resetTransform();
      pen.imageSmoothingEnabled = wide < bitmap.width; // enlarged frames show their pixels
      pen.drawImage(bitmap, 0, 0, wide, high);
      pen.scale(wide / look.size[0], high / look.size[1]);
      for (const mark of look.marks) {
        pen.strokeStyle = pen.fillStyle = mark.ink;
        pen.lineWidth = mark.width;
        pen.setLineDash(mark.dash);
        pen.stroke(new Path2D(mark.path));
        pen.font = `${mark.font}px ui-monospace, monospace`;
        for (const [x, y, name] of mark.names) { // dark background, readable over a bright sky
          pen.fillStyle = "rgb(13 16 21 / 65%)";
          pen.fillRect(x, y - 0.8 * mark.font, 0.61 * mark.font * name.length, mark.font);
          pen.fillStyle = mark.ink;
          pen.fillText(name, x, y);
        }
      }
      canvas.dataset.frame = look.src;
      canvas.ariaLabel = look.label;
    },
    // Report the mouse position in frame pixels from the frame's corner.
    told(event) {
      if (!this.drawn) return;
      const { clientWidth, clientHeight } = this.$el, [wide, high] = this.drawn.look.size;
      const x = (event.offsetX * wide) / clientWidth, y = (event.offsetY * high) / clientHeight;
      this.$emit("mouse", { kind: event.type, x, y });
    },
  },
};
