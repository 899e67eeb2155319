// Where pixels point: right ascension and declination, or azimuth and elevation of the dome's points.

const NODES = 41; // along each side, of the lattice on which lines of the grid are traced
const STEPS_DEG = [45, 30, 15, 10, 5, 2, 1, 0.5, 0.25, 0.1, 0.05];
const DEG = 180 / Math.PI;

// The value of a table of n x n nodes, from the frame's corner to its opposite corner, bilinear between them.
function interpolated(table, n, u, v) {
  const x = Math.min(Math.max(u * (n - 1), 0), n - 1), y = Math.min(Math.max(v * (n - 1), 0), n - 1);
  const column = Math.min(Math.floor(x), n - 2), row = Math.min(Math.floor(y), n - 2), at = row * n + column;
  const [a, b, c, d] = [at, at + 1, at + n, at + n + 1].map((node) => table[node] ?? NaN); // null: no value there
  const top = a + (x - column) * (b - a), under = c + (x - column) * (d - c);
  return top + (y - row) * (under - top);
}

// (longitude, latitude) in degrees of a pixel; null if the frame's attitude is unknown or the ray meets no surface.
// lens: tables of the tangents x / z, y / z; pose: rotation reference_from_cam by rows, and under a dome the camera's
// place and the table of depths along the boresight at which rays meet the surface.
export function direction({ lens, pose, size }, x, y) {
  if (!lens || !pose) return null;
  const u = (x + 0.5) / size[0], v = (y + 0.5) / size[1], R = pose.rotation;
  const a = interpolated(lens.x, lens.n, u, v), b = interpolated(lens.y, lens.n, u, v);
  let point = [0, 1, 2].map((row) => R[3 * row] * a + R[3 * row + 1] * b + R[3 * row + 2]);
  if (pose.depth_m) {
    const depth = interpolated(pose.depth_m, lens.n, u, v);
    point = point.map((value, axis) => pose.place_m[axis] + depth * value);
  }
  const length = Math.hypot(...point);
  if (!Number.isFinite(length)) return null;
  return [(Math.atan2(point[1], point[0]) * DEG + 360) % 360, Math.asin(point[2] / length) * DEG];
}

export function directionText(view, x, y) {
  const found = direction(view, x, y);
  if (!found) return "";
  const [longitude, latitude] = found;
  if (view.pose.depth_m) return `azimuth ${longitude.toFixed(2)}°  elevation ${latitude.toFixed(2)}°`;
  return `RA ${longitude.toFixed(4)}° ${hours(longitude)}  Dec ${signed(latitude, 4)}°`;
}

function hours(degrees) {
  const tenths = Math.round((degrees / 15) * 36000) % 864000; // tenths of a second
  const [h, m, s] = [Math.floor(tenths / 36000), Math.floor(tenths / 600) % 60, (tenths % 600) / 10];
  return `${h}h${String(m).padStart(2, "0")}m${s.toFixed(1).padStart(4, "0")}s`;
}

const signed = (value, digits) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(digits);

// Lines of equal longitude and latitude: [{path: [[x0, y0, x1, y1], ...], label}], in the frame's pixels.
export function gridLines(view) {
  const lattice = nodes(view);
  if (!lattice) return [];
  const middle = direction(view, view.size[0] / 2, view.size[1] / 2);
  if (!middle) return [];
  const relative = lattice.map((node) => node && ((node[0] - middle[0] + 540) % 360) - 180);
  return [
    ...lines(view, relative, middle[0], (value) => `${+(((value % 360) + 360) % 360).toFixed(2)}°`),
    ...lines(view, lattice.map((node) => node && node[1]), 0, (value) => `${signed(value, 2).replace(/\.?0+$/, "")}°`),
  ];
}

function nodes(view) {
  if (!view.lens || !view.pose) return null;
  const found = [];
  for (let row = 0; row < NODES; row++) {
    for (let column = 0; column < NODES; column++) {
      found.push(direction(view, (column / (NODES - 1)) * view.size[0] - 0.5, (row / (NODES - 1)) * view.size[1] - 0.5));
    }
  }
  return found;
}

// Contours of the values of the lattice, at multiples of a round step of which about five are in the field.
function lines(view, values, origin, text) {
  const known = values.filter((value) => value !== null);
  const range = Math.min(Math.max(...known) - Math.min(...known), 360);
  const step = STEPS_DEG.find((size) => range / size >= 3) ?? STEPS_DEG.at(-1);
  const found = [];
  const first = Math.ceil((Math.min(...known) + origin) / step), last = Math.floor((Math.max(...known) + origin) / step);
  for (let n = first; n <= last; n++) {
    const path = contour(view, values, n * step - origin);
    if (path.length) found.push({ path, label: text(n * step) });
  }
  return found;
}

// Segments on which the values reach a level, by marching squares; cells across the jump from 180 to -180 have none.
function contour({ size }, values, level) {
  const path = [], [dx, dy] = [size[0] / (NODES - 1), size[1] / (NODES - 1)];
  for (let row = 0; row < NODES - 1; row++) {
    for (let column = 0; column < NODES - 1; column++) {
      const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([x, y]) => [x, y, values[(row + y) * NODES + column + x]]);
      const heights = corners.map((corner) => corner[2]);
      if (heights.includes(null) || Math.max(...heights) - Math.min(...heights) > 120) continue;
      const points = [];
      corners.forEach(([x0, y0, from], k) => {
        const [x1, y1, to] = corners[(k + 1) % 4];
        if (from < level === to < level) return;
        const part = (level - from) / (to - from);
        points.push((column + x0 + part * (x1 - x0)) * dx, (row + y0 + part * (y1 - y0)) * dy);
      });
      for (let k = 0; k + 3 < points.length; k += 4) path.push(points.slice(k, k + 4));
    }
  }
  return path;
}
