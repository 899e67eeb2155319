// The lights as round points, each with the size and color of its state.
import { THREE } from "nicegui-scene";

const COLORS = { dark: 0x626d80, lit: 0xfff3dc, seen: 0xffab1a, identified: 0x1fc9a0, ringed: 0xffffff };
const SIZES = { dark: 0.7, lit: 1, seen: 1.8, identified: 2.2, colored: 3.2, ringed: 4 }; // over a light's own radius
const LEAST_PX = 1.5, MOST_PX = 40; // diameter on the screen
const FORWARD_M = 0.03; // towards the eye, so that the dome's skin does not cover a part of them
const SHADERS = {
  vertexShader: `attribute float size; attribute vec3 tint; varying vec3 shade; uniform float pixels;
    void main() { shade = tint; vec4 at = modelViewMatrix * vec4(position, 1.0);
      gl_PointSize = clamp(size * pixels / -at.z, ${LEAST_PX.toFixed(1)}, ${MOST_PX.toFixed(1)});
      gl_Position = projectionMatrix * vec4(at.xyz * (1.0 + ${FORWARD_M} / at.z), 1.0); }`,
  fragmentShader: `varying vec3 shade; void main() { float r = 2.0 * length(gl_PointCoord - 0.5);
      if (r > 1.0) discard; gl_FragColor = vec4(shade, mix(1.0, 0.25, smoothstep(0.35, 1.0, r))); }`,
};

// lights: { id, place: x, y, z of all, radius, lit }
export class Lights {
  constructor(lights) {
    const count = lights.id.length, geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(lights.place, 3));
    geometry.setAttribute("size", new THREE.Float32BufferAttribute(new Float32Array(count), 1));
    geometry.setAttribute("tint", new THREE.Float32BufferAttribute(new Float32Array(3 * count), 3));
    const uniforms = { pixels: { value: 1 } };
    const material = new THREE.ShaderMaterial({ ...SHADERS, uniforms, transparent: true, depthWrite: false });
    this.lights = lights;
    this.points = new THREE.Points(geometry, material);
    this.points.frustumCulled = false;
    this.states = lights.lit.map((lit) => (lit ? "lit" : "dark"));
    this.colors = new Map(); // by number, of those with a color of their own
  }
  // seen, identified: sets of numbers
  setFrame(seen, identified) {
    const { id, lit } = this.lights;
    this.states = id.map((one, n) => (identified.has(one) ? "identified" : seen.has(one) ? "seen" : lit[n] ? "lit" : "dark"));
  }
  count(state) {
    return this.states.filter((one) => one === state).length;
  }
  // marked: number of the light that is hovered here or elsewhere; null if none
  paint(marked) {
    const { size, tint } = this.points.geometry.attributes, color = new THREE.Color();
    this.states.forEach((state, n) => {
      const id = this.lights.id[n], shown = id === marked ? "ringed" : state, own = this.colors.get(id);
      size.array[n] = SIZES[own && shown !== "ringed" ? "colored" : shown] * this.lights.radius[n];
      color.set(shown === "ringed" ? COLORS.ringed : own ?? COLORS[shown]).convertLinearToSRGB().toArray(tint.array, 3 * n);
    });
    size.needsUpdate = tint.needsUpdate = true;
  }
  // Index of the light nearest to a place on the screen, within reach; null if none.
  nearest(camera, [x, y], [width, height], reach) {
    const at = new THREE.Vector3(), { id, place } = this.lights;
    let best = null, least = reach;
    for (let n = 0; n < id.length; n++) {
      at.fromArray(place, 3 * n).project(camera);
      if (at.z > 1) continue;
      const distance = Math.hypot(((at.x + 1) / 2) * width - x, ((1 - at.y) / 2) * height - y);
      if (distance < least) [best, least] = [n, distance];
    }
    return best;
  }
}
