// The laboratory in three dimensions: the shapes of its MJCF file, the lights as they shine, the vehicle's attitude.
// It is drawn only when something has changed: without a graphics card a picture takes the time of a frame.
import { OrbitControls, THREE } from "nicegui-scene";
import { drawNames } from "skysim-views/marks.js";
import { Lights } from "skysim-views/lights.js";
import { axes, band, solid } from "skysim-views/solids.js";

const BUSY_MS = 1000, SMOOTH_MS = 33; // between pictures without a graphics card, and with one or under the mouse
const REACH_PX = 12;
const PULL_MS = 40; // between two messages of a drag
const NEAR_M = 0.02, FAR_M = 60;
const ARROW = 0xff5fa8;
const DOT_PX = 5, NEARER = 0.97; // a dot of the map of coverage, and its distance over that of a light
const INSIDE = ["camera", "bearing"]; // views in which vehicle and axes would be in the way

export default {
  template: `
    <div class="lab-space" @pointerenter="inside = true" @pointerleave="leave">
      <canvas ref="canvas" role="img" aria-label="The laboratory" @pointerdown="hold" @pointermove="move"
        @pointerup="letGo" @pointercancel="letGo"></canvas>
      <canvas ref="names" class="lab-names"></canvas>
      <div ref="label" class="lab-tag mono"></div>
    </div>`,
  created() {
    // Not reactive: Vue must not watch the objects of three.js.
    // held: what the user drags: { body: its place in body axes, plane: in which it is pulled, wanted: to where }
    Object.assign(this, { held: null, telling: null });
    Object.assign(this, { inSight: false, newest: "" }); // whether a part of it is on the screen; the newest frame's fields
    Object.assign(this, { inside: false, hovered: null, ringed: null, preset: "outside", named: [], drawnAt: 0, drawings: 0 });
  },
  mounted() {
    const canvas = this.$refs.canvas;
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    } catch {
      this.$refs.label.textContent = "This browser has no WebGL, so there is no view of the laboratory.";
      return;
    }
    const gl = this.renderer.getContext(), info = gl.getExtension("WEBGL_debug_renderer_info");
    this.smooth = Boolean(info) && !/swiftshader|llvmpipe|software/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
    this.world = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(38, 1, NEAR_M, FAR_M);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("start", this.leavePreset);
    this.controls.addEventListener("change", () => this.draw());
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(this.$el);
    this.sight = new IntersectionObserver((entries) => this.see(entries.at(-1).isIntersecting));
    this.sight.observe(this.$el);
    window.addEventListener("skysim-hover", this.ring);
    window.addEventListener("skysim-arrows", this.drawArrows);
    window.addEventListener("skysim-coverage", this.drawCoverage);
  },
  beforeUnmount() {
    window.removeEventListener("skysim-hover", this.ring);
    window.removeEventListener("skysim-arrows", this.drawArrows);
    window.removeEventListener("skysim-coverage", this.drawCoverage);
    this.watcher?.disconnect();
    this.sight?.disconnect();
    this.renderer?.dispose();
  },
  methods: {
    // From the server.

    // Build the laboratory: { shapes, lights, views, background, prefix, axis }.
    build(lab) {
      if (!this.renderer) return;
      this.lab = lab;
      this.world.clear();
      this.world.background = new THREE.Color(lab.background);
      this.world.add(new THREE.HemisphereLight(0xcfdcff, 0x20242c, 1.6));
      const lamp = new THREE.DirectionalLight(0xffffff, 1.8);
      lamp.position.set(2, -2.5, 3);
      [this.vehicle, this.axes, this.band] = [new THREE.Group(), axes(lab.axis), band()];
      this.lights = new Lights(lab.lights);
      this.world.add(lamp, this.vehicle, this.axes, this.lights.points, this.band);
      for (const shape of lab.shapes) (shape.on_vehicle ? this.vehicle : this.world).add(solid(shape));
      this.named = [];
      this.newest = "";
      this.$refs.canvas.dataset.arrows = 0;
      this.paintLights();
      this.look(this.preset);
    },
    // The newest frame: { wxyz: lab_from_body, seen: numbers on the frame, identified: [number, name] each }. Without an
    // attitude the vehicle stays.
    show({ wxyz, seen, identified }) {
      const fields = JSON.stringify([wxyz, seen, identified]);
      if (!this.vehicle || fields === this.newest) return;
      this.newest = fields;
      if (wxyz) this.vehicle.quaternion.set(wxyz[1], wxyz[2], wxyz[3], wxyz[0]);
      this.lights.setFrame(new Set(seen), new Set(identified.map(([id]) => id)));
      const index = new Map(this.lab.lights.id.map((id, n) => [id, n]));
      this.named = identified.filter(([id]) => index.has(id)).map(([id, name]) => [index.get(id), name]);
      this.paintLights();
      if (this.preset === "camera") this.look("camera");
      this.placeBand();
      this.draw();
    },
    // Give some lights a color of their own: [number, color] each.
    color(pairs) {
      this.lights.colors = new Map(pairs);
      this.paintLights();
      this.draw();
    },
    // Arrows at some lights: [number, along x, y, z as an angle seen from the middle of the laboratory] each.
    drawArrows({ detail: { arrows } }) {
      if (!this.vehicle) return;
      this.world.remove(this.arrowLines);
      const index = new Map(this.lab.lights.id.map((id, n) => [id, n])), ends = [];
      for (const [id, along] of arrows) {
        if (!index.has(id)) continue;
        const from = new THREE.Vector3().fromArray(this.lab.lights.place, 3 * index.get(id));
        ends.push(from, from.clone().addScaledVector(new THREE.Vector3(...along), from.length()));
      }
      const material = new THREE.LineBasicMaterial({ color: ARROW });
      this.arrowLines = new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(ends), material);
      this.arrowLines.frustumCulled = false;
      this.world.add(this.arrowLines);
      this.$refs.canvas.dataset.arrows = ends.length / 2;
      this.draw();
    },
    // Dots where the boresight meets the lights: [direction, color] each.
    drawCoverage({ detail: { dots } }) {
      if (!this.vehicle) return;
      this.world.remove(this.dots);
      const geometry = new THREE.BufferGeometry(), place = new THREE.Vector3();
      const reach = NEARER * place.fromArray(this.lab.lights.place, 0).length();
      const tints = dots.flatMap(([, color]) => new THREE.Color(color).toArray());
      geometry.setFromPoints(dots.map(([at]) => new THREE.Vector3(...at).multiplyScalar(reach)));
      geometry.setAttribute("color", new THREE.Float32BufferAttribute(tints, 3));
      this.dots = new THREE.Points(geometry, new THREE.PointsMaterial({ size: DOT_PX, sizeAttenuation: false, vertexColors: true }));
      this.dots.frustumCulled = false;
      this.world.add(this.dots);
      this.$refs.canvas.dataset.dots = dots.length;
      this.draw();
    },
    // Look from a preset: [eye, target, up, vertical field in degrees, whether they are in body axes].
    look(name) {
      const view = this.lab?.views[name] ?? this.lab?.views.outside;
      if (!view || !this.vehicle) return;
      this.preset = name;
      const [from, to, above, fov, onVehicle] = view;
      const turn = onVehicle ? this.vehicle.quaternion : new THREE.Quaternion();
      const [eye, target, up] = [from, to, above].map((v) => new THREE.Vector3(...v).applyQuaternion(turn));
      this.camera.up.copy(up);
      this.camera.position.copy(eye);
      this.controls.target.copy(target);
      this.camera.fov = fov;
      this.camera.updateProjectionMatrix();
      this.camera.lookAt(target);
      this.vehicle.visible = this.axes.visible = !INSIDE.includes(name);
      this.$refs.canvas.dataset.view = name;
      this.draw(true);
    },

    // Drawing.

    // The user turns the view: it is no preset any more.
    leavePreset() {
      this.preset = this.$refs.canvas.dataset.view = "free";
      this.camera.up.set(0, 0, 1);
    },
    paintLights() {
      const marked = this.hovered ?? this.ringed, { dataset } = this.$refs.canvas;
      this.lights.paint(marked);
      dataset.lights = ["identified", "seen", "lit", "dark"].map((state) => `${state} ${this.lights.count(state)}`).join(", ");
      dataset.ringed = marked ?? "";
    },
    resize() {
      const { clientWidth, clientHeight } = this.$el;
      if (!clientWidth || !clientHeight) return;
      this.renderer.setPixelRatio(devicePixelRatio);
      this.renderer.setSize(clientWidth, clientHeight, false);
      this.camera.aspect = clientWidth / clientHeight;
      this.camera.updateProjectionMatrix();
      this.draw(true);
    },
    // Nothing is drawn while the view is closed, or scrolled away.
    see(inSight) {
      this.inSight = inSight;
      if (inSight) this.draw(true);
    },
    // Draw soon; pictures are further apart without a graphics card, unless the mouse is here.
    draw(now = false) {
      if (this.waiting || !this.inSight) return;
      const pause = now || this.smooth || this.inside ? SMOOTH_MS : BUSY_MS;
      const wait = Math.max(0, this.drawnAt + pause - performance.now());
      this.waiting = setTimeout(() => requestAnimationFrame(this.render), wait);
    },
    render() {
      this.waiting = null;
      this.drawnAt = performance.now();
      if (!this.lights || !this.inSight || !this.$el.clientWidth || !this.$el.clientHeight) return;
      const size = this.renderer.getDrawingBufferSize(new THREE.Vector2());
      this.lights.points.material.uniforms.pixels.value = size.y / Math.tan((this.camera.fov * Math.PI) / 360);
      this.renderer.render(this.world, this.camera);
      this.writeNames();
      this.$refs.canvas.dataset.drawn = ++this.drawings;
    },
    writeNames() {
      const canvas = this.$refs.names, pen = canvas.getContext("2d"), { clientWidth, clientHeight } = this.$el;
      [canvas.width, canvas.height] = [clientWidth * devicePixelRatio, clientHeight * devicePixelRatio];
      pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
      const names = this.named.map(([n, name]) => [...this.place(n), name]).filter(([x]) => x !== null);
      drawNames(pen, names, (x, y) => [x, y], [clientWidth, clientHeight], "#6ff0d8", this.overlaid());
    },
    // Boxes of the buttons and texts over the view.
    overlaid() {
      const { left, top } = this.$el.getBoundingClientRect();
      return [this.$refs.label, ...this.$el.parentElement.querySelectorAll(".lab-looks > *, .lab-turn, .lab-push")]
        .map((one) => one.getBoundingClientRect())
        .map((box) => [box.left - left, box.top - top, box.right - left, box.bottom - top]);
    },
    // Where a light is on the screen; null behind the eye.
    place(n) {
      const at = new THREE.Vector3().fromArray(this.lab.lights.place, 3 * n).project(this.camera);
      if (at.z > 1) return [null, null];
      return [((at.x + 1) / 2) * this.$el.clientWidth, ((1 - at.y) / 2) * this.$el.clientHeight];
    },

    // Pushing the vehicle: a drag that begins on it pulls at that point, in the plane that faces the eye.

    ray(event) {
      const { clientWidth, clientHeight } = this.$el, caster = new THREE.Raycaster();
      const at = new THREE.Vector2((2 * event.offsetX) / clientWidth - 1, 1 - (2 * event.offsetY) / clientHeight);
      caster.setFromCamera(at, this.camera);
      return caster;
    },
    hold(event) {
      if (!this.vehicle?.visible || event.button !== 0) return;
      const solids = this.vehicle.children.filter(({ name }) => !name.startsWith("stage"));
      const [hit] = this.ray(event).intersectObjects(solids);
      if (!hit) return;
      const away = this.camera.getWorldDirection(new THREE.Vector3());
      const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(away, hit.point);
      const body = hit.point.clone().applyQuaternion(this.vehicle.quaternion.clone().invert());
      this.held = { body, plane, wanted: hit.point };
      this.controls.enabled = false;
      this.$refs.canvas.setPointerCapture(event.pointerId);
      this.pull(event);
    },
    pull(event) {
      this.held.wanted = this.ray(event).ray.intersectPlane(this.held.plane, new THREE.Vector3()) ?? this.held.wanted;
      this.placeBand();
      this.draw();
      this.telling ??= setTimeout(this.tell, PULL_MS);
    },
    tell() {
      this.telling = null;
      if (this.held) this.$emit("grip", { held: this.held.body.toArray(), wanted: this.held.wanted.toArray() });
    },
    letGo() {
      if (!this.held) return;
      this.held = null;
      this.controls.enabled = true;
      this.$emit("release");
      this.placeBand();
      this.draw(true);
    },
    // The line from the held point to where it is pulled.
    placeBand() {
      this.band.visible = Boolean(this.held);
      if (!this.held) return;
      const from = this.held.body.clone().applyQuaternion(this.vehicle.quaternion);
      this.band.geometry.setFromPoints([from, this.held.wanted]);
    },

    // Hovered lights, here and elsewhere on the page.

    ring({ detail: { id } }) {
      if (id === this.ringed || !this.lights) return;
      this.ringed = id;
      this.paintLights();
      this.draw(true);
    },
    move(event) {
      if (this.held) this.pull(event);
      if (!this.lights || event.buttons) return;
      const { clientWidth, clientHeight } = this.$el, at = [event.offsetX, event.offsetY];
      const found = this.lights.nearest(this.camera, at, [clientWidth, clientHeight], REACH_PX);
      this.hover(found === null ? null : this.lab.lights.id[found]);
      this.$refs.label.style.transform = `translate(${at[0] + 12}px, ${at[1] - 8}px)`;
    },
    hover(id) {
      if (id === this.hovered) return;
      this.hovered = id;
      this.$refs.label.textContent = id === null ? "" : `${this.lab.prefix} ${id}`;
      window.dispatchEvent(new CustomEvent("skysim-hover", { detail: { id } }));
      this.paintLights();
      this.draw();
    },
    leave() {
      this.inside = false;
      if (this.lights) this.hover(null);
    },
  },
};
