// The frame: its pixels come as numbers, so zoom, limits, colors, values under the cursor, loupe and cut are made here,
// without the server. Marks are drawn together with their frame, so that they never appear on another one.
import { setContents } from "skysim-views/live.js";
import { colorTable, decode, palette, profile, reader, shadeTable } from "skysim-views/pixels.js";
import { drawArrows, drawGrid, drawHighlight, drawLoupe, drawMarks, drawNames } from "skysim-views/marks.js";
import { brief, drawHistogram, drawProfile, electrons, levelAt, nearestLevel } from "skysim-views/plots.js";
import { directionText, gridLines } from "skysim-views/sky.js";

const REST_MS = 400; // without another frame, after which all pixels of the frame are fetched
const AHEAD = 1; // frames that are fetched while another one is drawn
const PLOT_MS = 250; // between histograms while frames follow one another
const LARGEST_PX = 60; // screen pixels of an enlarged pixel
const REACH_PX = 14; // screen pixels within which the cursor finds a light
const LOUPE = { across: 11, down: 7 };
const PALE = "#ffe27a", GRID = "rgb(127 160 200 / 62%)", CUT = "#ff8fd0", CROSS = "#dd5a60", NAME = "#6ff0d8";

const HINT = "arrow keys: from light to light, the brightest first · Enter: its data · Esc: the camera's keys again";
const STEPS = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };

const numberOf = (src) => Number(src.slice(src.lastIndexOf("/") + 1));

export default {
  template: `
    <div class="lab-view">
      <div class="lab-frame">
        <canvas ref="frame" role="application" tabindex="0" :aria-description="hint" @wheel.prevent="wheel"
          @mousedown.prevent @pointerdown="press" @pointermove="move" @pointerup="release" @pointercancel="release"
          @pointerleave="leave" @dblclick="fit" @focus="enter" @blur="exit" @keydown="key"></canvas>
        <div ref="said" class="lab-unseen" aria-live="polite"></div>
        <slot name="wait"></slot>
      </div>
      <div class="lab-readout">
        <span ref="readout" class="mono"></span>
        <button @click="fit" title="the whole frame (double-click)">fit</button>
        <button @click="actualSize" title="a screen pixel for each pixel">1:1</button>
      </div>
      <div class="lab-under">
        <canvas ref="loupe" class="lab-loupe" role="img"></canvas>
        <slot></slot>
        <canvas ref="plot" class="lab-plot" role="img" @pointerdown="grab" @pointermove="drag"
          @pointerup="drop" @pointercancel="drop"></canvas>
      </div>
    </div>`,
  // curve, limits: names;  table: of colors, base64;  grid: whether the coordinate grid is drawn
  props: { display: Object },
  created() {
    // Not reactive: Vue must not watch arrays of a million pixels.
    Object.assign(this, {
      hint: HINT,
      stepping: false, // whether the frame has the focus, by the Tab key, so that the arrow keys step from light to light
      stop: -1, // index of the light of the last step
      wanted: null, // the newest view: src, and other marks than those that come with it: size, saturation, pose, label,
      // marks, names, lights
      drawn: null, // the view on the canvas, with its pixels, all or fewer
      atRest: null, // timer
      plottedAt: 0,
      openedAt: performance.now(),
      clock: null, // timer while there is no frame
      lens: null,
      zoom: null, // { scale, x, y }: screen pixels per pixel, and the pixel in the middle; null: the whole frame
      cursor: null, // [x, y] in the frame's pixels
      pinned: null, // where the loupe stays while the cursor is elsewhere
      cut: null, // [[x, y], [x, y]]
      manual: null, // limits that were dragged
      pressed: null,
      held: null, // the limit that is dragged: 0 or 1
      hovered: null, // number of the light under the cursor
      begun: null, // the newest view whose frame is fetched or drawn
      fetchedSrc: null,
      inFlight: 0, // frames that are fetched or drawn
      newest: 0, // greatest number of a frame that has come
      emptied: 0, // number of the last frame before the view was emptied
      isListening: false, // whether a stream of frames is open
      queue: Promise.resolve(),
      space: [0, 0], // width and height of the canvas
    });
  },
  mounted() {
    this.pen = this.$refs.frame.getContext("2d", { alpha: false, willReadFrequently: true });
    this.sheet = document.createElement("canvas");
    this.watcher = new ResizeObserver(() => {
      this.space = [this.$refs.frame.clientWidth, this.$refs.frame.clientHeight];
      this.paint();
    });
    for (const canvas of [this.$refs.frame, this.$refs.loupe, this.$refs.plot]) this.watcher.observe(canvas);
    window.addEventListener("skysim-hover", this.ring);
    this.clock = setInterval(this.showWaited, 1000);
    window.addEventListener("keydown", this.listen); // the key's frame then comes without a request of its own
  },
  beforeUnmount() {
    clearInterval(this.clock);
    window.removeEventListener("keydown", this.listen);
    window.removeEventListener("skysim-hover", this.ring);
    this.watcher.disconnect();
  },
  watch: {
    display(now, before) {
      if (now.limits !== "manual") this.manual = null;
      this.recolor();
      if (now.limits !== before.limits || now.curve !== before.curve) this.complete(true);
    },
  },
  methods: {
    // From the server.

    setContents,
    // Timer: for how long the first frame has been waited for.
    showWaited() {
      const waited = this.$el.querySelector(".lab-waited");
      if (this.drawn || !waited) clearInterval(this.clock);
      else waited.textContent = `${Math.round((performance.now() - this.openedAt) / 1000)} s`;
    },
    show(view) {
      if (numberOf(view.src) < this.newest) return; // a newer one has come over the stream
      this.wanted = view;
      this.update();
    },
    // Receive the frames that follow one another over one response, which ends after a while without frames. A hidden
    // tab leaves the browser's connections to others.
    async listen() {
      if (this.isListening || !this.drawn || document.hidden) return;
      this.isListening = true;
      try {
        const folder = this.drawn.src.slice(0, this.drawn.src.lastIndexOf("/"));
        const response = await fetch(`${window.path_prefix || ""}${folder}/next?${this.query()}`);
        if (response.ok) await this.followStream(response.body.getReader(), folder);
      } catch {
        // The server is unreachable; it announces the newest frame when it is not.
      } finally {
        this.isListening = false;
      }
    },
    async followStream(source, folder) {
      const read = reader(source);
      try {
        for (let head; (head = await read(8)); ) {
          const [length, number] = new Uint32Array(head), body = await read(length);
          if (body) this.receive(`${folder}/${number}`, body);
        }
      } finally {
        source.cancel().catch(() => {});
      }
    },
    receive(src, body) {
      const number = numberOf(src);
      if (number <= this.newest) return;
      const frame = { ...decode(body), src };
      if (!frame.isWhole && !this.screen()[0]) return this.show({ src }); // zoomed since
      this.newest = number;
      this.wanted = this.begun = { src };
      this.fetchedSrc = src;
      this.enqueue(this.begun, frame, true);
    },
    // Show no image: those up to a number are not what the page is about.
    empty(number) {
      clearTimeout(this.atRest);
      Object.assign(this, { emptied: number, drawn: null, cursor: null, pinned: null, cut: null, hovered: null, hoverKey: null });
      const { frame, loupe, plot, readout } = this.$refs;
      for (const canvas of [frame, loupe, plot]) [canvas.width, canvas.ariaLabel] = [0, "no image"];
      delete frame.dataset.frame;
      readout.textContent = "";
    },
    setLens(lens) {
      this.lens = lens;
    },
    fit() {
      this.zoom = null;
      this.paint();
    },
    actualSize() {
      if (!this.drawn) return;
      const [width, height] = this.drawn.size;
      this.zoom = { scale: 1 / devicePixelRatio, x: width / 2, y: height / 2 };
      this.paint();
    },

    // Pixels.

    // Fetch the newest view, while up to AHEAD others are fetched or drawn; draw them in their order.
    update() {
      if (this.inFlight > AHEAD || this.wanted === this.begun) return;
      const view = (this.begun = this.wanted), isNew = view.src !== this.fetchedSrc;
      this.newest = Math.max(this.newest, numberOf(view.src));
      this.fetchedSrc = view.src;
      this.enqueue(view, isNew ? this.fetchFrame(view.src) : null, isNew);
    },
    // frame: with its pixels, or when they will have come; null: the one that is drawn then
    enqueue(view, frame, isNew) {
      const { lens } = this;
      this.inFlight += 1;
      this.queue = this.queue.catch(() => {}).then(async () => {
        try {
          this.take(view, lens, isNew ? await frame : this.drawn, isNew);
        } finally {
          this.inFlight -= 1;
          this.update();
        }
      });
    },
    // Draw a fetched frame, or other marks of the one that is drawn.
    take(view, lens, frame, isNew) {
      if (frame?.src !== view.src) return; // the fetch has failed; a newer frame will be announced
      if (numberOf(view.src) <= this.emptied) return;
      if (String(frame.size) !== String(this.drawn?.size)) this.zoom = this.cut = this.pinned = null;
      this.drawn = { ...frame, ...view, view, lens };
      if (isNew) this.recolor();
      else this.paint();
      if (isNew) setContents(frame.contents); // last: sizes are read above, which a changed text would delay
      this.$emit("drawn", { src: view.src, display: String(this.query()) });
      if (isNew) this.listen();
      clearTimeout(this.atRest);
      if (!this.drawn.isWhole) this.atRest = setTimeout(this.complete, REST_MS);
    },
    // Fetch all pixels of the drawn frame, if there are fewer or the limits are others.
    async complete(always = false) {
      clearTimeout(this.atRest);
      const { drawn, manual } = this, { limits: named, curve } = this.display;
      if (this.inFlight || !drawn || (drawn.isWhole && always !== true)) return;
      const frame = await this.fetchFrame(drawn.src, true);
      if (!frame || this.drawn?.src !== drawn.src) return;
      if (this.display.limits !== named || this.display.curve !== curve || this.manual !== manual) return; // chosen since
      const { pixels, isWhole, limits, histogram } = frame;
      this.drawn = { ...this.drawn, pixels, isWhole, limits, histogram };
      this.recolor();
    },
    // How the next frames are drawn.
    query() {
      const { curve, limits } = this.display, near = this.loupeAt() ?? [];
      return new URLSearchParams({ screen: this.screen(), limits: this.manual ?? limits, curve, near });
    },
    // Width and height of the screen that a whole frame fills; zeros if all its pixels are needed.
    screen() {
      return this.space.map((side) => (this.zoom || this.cut ? 0 : Math.round(side * devicePixelRatio)));
    },
    // A frame's pixels with its pointing and its marks, the pixels as shades of as many as the screen has unless all are
    // needed; null if the server is unreachable or holds only newer frames, which it will announce.
    async fetchFrame(src, whole = false) {
      try {
        const query = this.query();
        if (whole) query.set("whole", 1);
        const response = await fetch(`${window.path_prefix || ""}${src}?${query}`);
        return response.ok ? { ...decode(await response.arrayBuffer()), src } : null;
      } catch {
        return null;
      }
    },
    recolor() {
      if (!this.drawn) return;
      const { pixels, histogram, saturation, isWhole } = this.drawn;
      const { data, offset, step, width, height } = pixels;
      const levels = this.manual?.map((dn) => (dn - offset) / step);
      this.levels = levels ?? this.drawn.limits;
      const limit = saturation === null ? Infinity : (saturation - offset) / step, colors = palette(this.display.table);
      const table = isWhole
        ? colorTable(histogram.range[1], this.levels, this.display.curve, colors, limit)
        : shadeTable(colors);
      if (this.sheet.width !== width || this.sheet.height !== height || !this.sheetData) {
        [this.sheet.width, this.sheet.height] = [width, height];
        this.sheetPen = this.sheet.getContext("2d", { alpha: false, willReadFrequently: true });
        this.sheetData = this.sheetPen.createImageData(width, height);
      }
      const out = new Uint32Array(this.sheetData.data.buffer);
      for (let n = 0; n < data.length; n++) out[n] = table[data[n]];
      this.paint();
    },
    // A pixel's value; null outside of the frame, or if only means over areas have been fetched.
    value(x, y) {
      const { pixels, size, isWhole, near } = this.drawn, [width, height] = size;
      if (x < 0 || y < 0 || x >= width || y >= height) return null;
      if (isWhole) return pixels.offset + pixels.step * pixels.data[y * width + x];
      const level = near && near.levels[y - near.y]?.[x - near.x];
      return level === undefined ? null : pixels.offset + pixels.step * level;
    },
    // Column and row of the loupe's upper left pixel; null without a loupe.
    loupeAt() {
      const at = this.cursor ?? this.pinned;
      if (!at || !this.drawn) return null;
      const [width, height] = this.drawn.size, { across, down } = LOUPE;
      return [
        Math.min(Math.max(Math.round(at[0]) - (across >> 1), 0), Math.max(width - across, 0)),
        Math.min(Math.max(Math.round(at[1]) - (down >> 1), 0), Math.max(height - down, 0)),
      ];
    },

    // Geometry: pixels of the frame (integers are centers) to screen pixels of the canvas and back.

    placement() {
      const { clientWidth, clientHeight } = this.$refs.frame, [width, height] = this.drawn.size;
      const whole = Math.min(clientWidth / width, clientHeight / height);
      const scale = this.zoom?.scale ?? whole;
      const [x, y] = this.zoom ? [this.zoom.x, this.zoom.y] : [width / 2, height / 2];
      return { whole, scale, left: clientWidth / 2 - x * scale, top: clientHeight / 2 - y * scale };
    },
    toScreen(x, y) {
      const { scale, left, top } = this.placed;
      return [left + (x + 0.5) * scale, top + (y + 0.5) * scale];
    },
    toFrame(event) {
      const { scale, left, top } = this.placed;
      return [(event.offsetX - left) / scale - 0.5, (event.offsetY - top) / scale - 0.5];
    },

    // Drawing.

    // Adapt a canvas to the screen's resolution; its pen then counts in CSS pixels.
    sized(canvas) {
      const wide = Math.round(canvas.clientWidth * devicePixelRatio);
      const high = Math.round(canvas.clientHeight * devicePixelRatio);
      if (!wide || !high) return null;
      if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
      const pen = canvas === this.$refs.frame ? this.pen : canvas.getContext("2d");
      pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
      return pen;
    },
    paint() {
      const canvas = this.$refs.frame, pen = this.drawn && this.sized(canvas);
      if (!pen) return;
      const { size, marks, names, lights } = this.drawn, window = [canvas.clientWidth, canvas.clientHeight];
      this.placed = this.placement();
      const { scale, left, top } = this.placed;
      pen.fillStyle = "#000";
      pen.fillRect(0, 0, ...window);
      this.paintPixels(pen);
      pen.strokeStyle = "#56606f";
      pen.lineWidth = 1;
      pen.strokeRect(left - 0.5, top - 0.5, size[0] * scale + 1, size[1] * scale + 1);
      if (this.display.grid) drawGrid(pen, this.lines(), this.toScreen, window, GRID);
      drawMarks(pen, marks, this.toScreen);
      canvas.dataset.arrows = drawArrows(pen, this.drawn.residuals, size[0], this.toScreen, window);
      drawNames(pen, names, this.toScreen, window, NAME);
      if (this.cut) this.paintCut(pen);
      const ringed = lights.find((light) => light[2] === this.hovered && light[2] >= 0);
      if (ringed) drawHighlight(pen, this.toScreen(ringed[0], ringed[1]), PALE);
      canvas.dataset.frame = this.drawn.src;
      canvas.dataset.whole = this.drawn.isWhole;
      canvas.dataset.placement = [left, top, scale].map((value) => value.toFixed(6)).join(" ");
      canvas.dataset.ringed = ringed ? ringed[2] : "";
      canvas.ariaLabel = this.drawn.label;
      this.paintUnder();
    },
    paintPixels(pen) {
      const { scale, left, top } = this.placed, { size, isWhole } = this.drawn, wide = scale * devicePixelRatio;
      if (!isWhole && this.sheet.width === Math.round(size[0] * wide)) {
        // A pixel for each of the screen's: a copy without interpolation.
        pen.putImageData(this.sheetData, Math.round(left * devicePixelRatio), Math.round(top * devicePixelRatio));
        return;
      }
      this.sheetPen.putImageData(this.sheetData, 0, 0);
      pen.imageSmoothingEnabled = wide < 1; // enlarged frames show their pixels
      pen.imageSmoothingQuality = wide < 0.5 ? "medium" : "low"; // so that no star is skipped
      pen.drawImage(this.sheet, left, top, size[0] * scale, size[1] * scale);
    },
    lines() {
      if (this.gridOf !== this.drawn.view) {
        this.gridOf = this.drawn.view;
        this.gridKept = gridLines(this.drawn);
      }
      return this.gridKept;
    },
    paintCut(pen) {
      const [from, to] = this.cut.map((end) => this.toScreen(...end));
      pen.strokeStyle = CUT;
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.moveTo(...from);
      pen.lineTo(...to);
      pen.stroke();
    },
    // Loupe, plot and readout.
    paintUnder() {
      if (!this.drawn) return;
      const now = performance.now(), plot = this.$refs.plot;
      if (!this.drawn.isWhole && now < this.plottedAt + PLOT_MS) {
        this.paintLoupe();
        this.writeReadout();
        return;
      }
      this.plottedAt = now;
      const pen = this.sized(plot);
      const { offset, step } = this.drawn.pixels, limits = this.levels.map((level) => offset + step * level);
      plot.dataset.limits = limits.map((dn) => dn.toPrecision(8)).join(" ");
      if (pen && this.cut && this.drawn.isWhole) {
        const found = profile(this.drawn.pixels, ...this.cut);
        drawProfile(pen, found, [plot.clientWidth, plot.clientHeight], CUT);
        plot.dataset.cut = this.cut.flat().map((value) => value.toFixed(4)).join(" ");
        plot.dataset.profile = found.values.map((dn) => dn.toFixed(1)).join(" ");
        plot.ariaLabel = `profile of the cut, ${found.values.length} values`;
      } else if (pen) {
        const peaks = this.peaks();
        this.axis = drawHistogram(pen, this.drawn, this.levels, [plot.clientWidth, plot.clientHeight], peaks);
        plot.ariaLabel = `histogram; limits ${limits.map((dn) => dn.toFixed(1)).join(" to ")} DN`;
        if (this.drawn.well && peaks.length) {
          const most = electrons(offset + step * Math.max(...peaks), this.drawn.well);
          plot.ariaLabel += `; brightest pixel of ${peaks.length} lights ${most.toFixed(0)} of ${this.drawn.well[2]} electrons`;
        }
      }
      this.paintLoupe();
      this.writeReadout();
    },
    // The greatest level of the pixels about each detection, if all pixels are here.
    peaks() {
      const { lights, isWhole, pixels: { data }, size: [width, height] } = this.drawn;
      if (!isWhole) return [];
      return lights.filter((light) => light[3]).map(([x, y]) => {
        let most = 0;
        for (let row = Math.round(y) - 1; row <= Math.round(y) + 1; row++)
          for (let column = Math.round(x) - 1; column <= Math.round(x) + 1; column++)
            if (row >= 0 && row < height && column >= 0 && column < width) most = Math.max(most, data[row * width + column]);
        return most;
      });
    },
    paintLoupe() {
      const corner = this.loupeAt();
      if (!corner) return this.clearLoupe();
      const [x, y] = corner, { across, down } = LOUPE, { pixels: { step }, isWhole, near } = this.drawn;
      if (!isWhole && !(near?.x === x && near.y === y)) return this.clearLoupe(); // no pixels of an earlier frame
      const canvas = this.$refs.loupe, pen = this.sized(canvas), dn = [];
      if (!pen) return;
      for (let row = y; row < y + down; row++) for (let column = x; column < x + across; column++) dn.push(this.value(column, row) ?? 0);
      const low = Math.min(...dn), range = Math.max(Math.max(...dn) - low, step);
      const gray = (value) => Math.round(255 * Math.sqrt((value - low) / range));
      const crosses = this.drawn.lights.filter((light) => light[3]);
      drawLoupe(pen, { x, y, across, down, dn }, gray, crosses, [canvas.clientWidth, canvas.clientHeight], CROSS);
      canvas.ariaLabel = `pixels from ${x} ${y}, ${across} by ${down}: ${dn.map((value) => value.toFixed(0)).join(" ")}`;
    },
    clearLoupe() {
      this.$refs.loupe.width = 0;
      this.$refs.loupe.ariaLabel = "";
    },
    writeReadout() {
      const readout = this.$refs.readout, at = this.cursor ?? this.pinned;
      const [x, y] = at ? at.map(Math.round) : [0, 0], dn = at && this.value(x, y);
      if (dn === null) {
        readout.textContent = this.stepping ? HINT : "wheel: zoom · drag: pan · shift-drag: cut · double-click: whole frame";
        return;
      }
      const number = this.drawn.pixels.step === 1 ? dn.toFixed(0) : dn.toFixed(2);
      const place = `x ${at[0].toFixed(1)}  y ${at[1].toFixed(1)}`.padEnd(20);
      const { well } = this.drawn, charge = well ? electrons(dn, well) : 0;
      const share = well ? ` ${brief(charge)} e⁻ ${((100 * charge) / well[2]).toFixed(0)} %` : "";
      readout.textContent = `${place}${number.padStart(6)} DN${share}   ${directionText(this.drawn, at[0], at[1])}`;
    },

    // Mouse and touch on the frame.

    wheel(event) {
      if (!this.drawn) return;
      const [x, y] = this.toFrame(event), { scale, whole } = this.placed;
      const next = Math.min(Math.max(scale * 1.0018 ** -event.deltaY, 0.5 * whole), Math.max(LARGEST_PX, whole));
      const { clientWidth, clientHeight } = this.$refs.frame; // the pixel under the cursor stays there
      this.zoom = {
        scale: next,
        x: x + 0.5 + (clientWidth / 2 - event.offsetX) / next,
        y: y + 0.5 + (clientHeight / 2 - event.offsetY) / next,
      };
      this.paint();
    },
    press(event) {
      document.activeElement.blur();
      if (!this.drawn || event.button !== 0) return;
      this.$refs.frame.setPointerCapture(event.pointerId);
      const { left, top, scale } = this.placed, [width, height] = this.drawn.size;
      const { clientWidth, clientHeight } = this.$refs.frame;
      const middle = this.zoom ?? { scale, x: (clientWidth / 2 - left) / scale, y: (clientHeight / 2 - top) / scale };
      this.pressed = { from: [event.offsetX, event.offsetY], start: this.toFrame(event), middle, cutting: event.shiftKey };
      if (event.shiftKey) this.cut = null;
      this.complete();
    },
    move(event) {
      if (!this.drawn) return;
      const at = this.toFrame(event);
      if (this.pressed) {
        const [dx, dy] = [event.offsetX - this.pressed.from[0], event.offsetY - this.pressed.from[1]];
        this.pressed.moved ||= Math.hypot(dx, dy) > 3;
        if (!this.pressed.moved) return;
        if (this.pressed.cutting) this.cut = [this.pressed.start, at];
        else {
          const { scale, x, y } = this.pressed.middle;
          this.zoom = { scale, x: x - dx / scale, y: y - dy / scale };
        }
        this.cursor = at;
        this.paint();
        return;
      }
      this.cursor = at;
      this.hover(at);
      this.complete();
      this.paintUnder();
    },
    // Report the light under the cursor when it is another one.
    hover(at) {
      const found = at && this.nearest(at), id = found ? found[2] : null;
      const key = found ? `${found[0]} ${found[1]}` : null;
      if (key === this.hoverKey) return;
      this.hoverKey = key;
      this.mark(found, id);
      window.dispatchEvent(new CustomEvent("skysim-hover", { detail: { id: id >= 0 ? id : null } }));
    },
    // A light is hovered elsewhere on the page, or no more.
    ring({ detail: { id } }) {
      if (this.drawn && id !== (this.hovered >= 0 ? this.hovered : null)) {
        this.mark(this.drawn.lights.find((light) => light[2] === id), id);
      }
    },
    mark(light, id) {
      this.hovered = id;
      this.paint();
      this.$emit("hover", { x: light?.[0], y: light?.[1], inside: Boolean(light) });
    },
    nearest(at) {
      const reach = REACH_PX / this.placed.scale;
      let best = null, least = reach;
      for (const light of this.drawn.lights) {
        const distance = Math.hypot(light[0] - at[0], light[1] - at[1]);
        if (distance < least) [best, least] = [light, distance];
      }
      return best;
    },
    release(event) {
      const pressed = this.pressed;
      this.pressed = null;
      if (!this.drawn || !pressed || pressed.moved || event.type === "pointercancel") return;
      if (pressed.cutting) this.cut = null;
      const found = this.nearest(pressed.start);
      this.pinned = found ? [found[0], found[1]] : pressed.start;
      this.$emit("hover", { x: this.pinned[0], y: this.pinned[1], inside: Boolean(found) });
      this.paint();
    },
    leave() {
      if (this.pressed || !this.drawn) return;
      this.cursor = null;
      this.hover(null);
      this.paintUnder();
    },

    // Keyboard on the frame.

    enter() {
      this.stepping = true;
      this.paintUnder();
    },
    exit() {
      this.stepping = false;
      this.leave();
    },
    key(event) {
      if (!this.stepping || !this.drawn) return;
      if (event.key === "Escape") this.$refs.frame.blur();
      else if (event.key === "Enter") this.tell();
      else if (STEPS[event.key]) this.step(STEPS[event.key]);
      else return;
      event.preventDefault();
      event.stopPropagation(); // the camera stays
    },
    // Show the next light, or the one before: true lights, then detections of none of them.
    step(by) {
      const { lights, names } = this.drawn, own = new Set(lights.filter((light) => !light[3]).map((light) => light[2]));
      const stops = lights.filter((light) => !light[3] || !own.has(light[2])), count = stops.length;
      if (!count) return this.say("no lights");
      this.stop = this.stop < 0 && by < 0 ? count - 1 : (this.stop + by + count) % count;
      const [x, y, id] = stops[this.stop];
      this.cursor = [x, y];
      if (this.zoom) this.zoom = { ...this.zoom, x: x + 0.5, y: y + 0.5 };
      this.hoverKey = `${x} ${y}`;
      this.mark(stops[this.stop], id);
      window.dispatchEvent(new CustomEvent("skysim-hover", { detail: { id: id >= 0 ? id : null } }));
      this.complete();
      const found = lights.find((light) => light[3] && light[2] === id && id >= 0);
      const name = found && names.find(([a, b]) => a === found[0] && b === found[1])?.[2];
      const what = id < 0 ? "no light" : `${name ?? id}${found ? ", identified" : ""}`;
      this.say(`${this.stop + 1} of ${count}: ${what}, x ${x}, y ${y}`);
    },
    // Keep the light in the loupe, and say its data.
    tell() {
      this.pinned = this.cursor ?? this.pinned;
      this.say(this.$el.querySelector(".lab-under .mono").textContent);
      this.paint();
    },
    say(text) {
      this.$refs.said.textContent = text;
    },

    // Mouse on the histogram: its two lines are the limits.

    grab(event) {
      if (!this.drawn || this.cut) return;
      this.$refs.plot.setPointerCapture(event.pointerId);
      this.held = nearestLevel(this.axis, this.levels, event.offsetX);
      this.drag(event);
    },
    drag(event) {
      if (this.held === null) return;
      const { offset, step } = this.drawn.pixels, limits = this.levels.map((level) => offset + step * level);
      limits[this.held] = offset + step * levelAt(this.axis, event.offsetX);
      if (!(limits[0] < limits[1])) return;
      if (!this.manual) this.$emit("manual");
      this.manual = limits;
      this.recolor();
    },
    // The server makes the next frames with these limits.
    drop() {
      if (this.held !== null) this.complete(true);
      this.held = null;
    },
  },
};
