// Marks and names over a frame, in screen pixels, so that they stay small and clear of the stars at any zoom.

const SIZE = 6, FONT = 11, LETTER = 0.61; // half width of a mark; font size, and width of a letter over it
const REACH = { truth: 1.5, faint: 0.1, detected: 1.1, identified: 1.7, false: 1, windows: 2.4 }; // half widths over SIZE
const SHAPES = {
  truth: (pen, x, y) => {
    for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + 0.8 * SIZE * a, y + 0.8 * SIZE * b);
      pen.lineTo(x + 1.5 * SIZE * a, y + 1.5 * SIZE * b);
    }
  },
  faint: (pen, x, y) => pen.rect(x - 0.5, y - 0.5, 1, 1),
  detected: (pen, x, y) => pen.rect(x - 1.1 * SIZE, y - 1.1 * SIZE, 2.2 * SIZE, 2.2 * SIZE),
  identified: (pen, x, y) => {
    pen.moveTo(x + 1.7 * SIZE, y);
    pen.arc(x, y, 1.7 * SIZE, 0, 2 * Math.PI);
  },
  false: (pen, x, y) => {
    pen.moveTo(x - SIZE, y - SIZE);
    pen.lineTo(x + SIZE, y + SIZE);
    pen.moveTo(x - SIZE, y + SIZE);
    pen.lineTo(x + SIZE, y - SIZE);
  },
  windows: (pen, x, y) => pen.rect(x - 2.4 * SIZE, y - 2.4 * SIZE, 4.8 * SIZE, 4.8 * SIZE),
};

// toScreen: from a frame's pixel to [x, y];  marks: [{kind, color, points: [[x, y], ...]}]
export function drawMarks(pen, marks, toScreen) {
  for (const { kind, color, points } of marks) {
    const stamp = stampOf(kind, color), half = stamp.width / 2 / devicePixelRatio;
    for (const [x, y] of points) {
      const [left, top] = toScreen(x, y).map((at) => Math.round((at - half) * devicePixelRatio) / devicePixelRatio);
      pen.drawImage(stamp, left, top, 2 * half, 2 * half);
    }
  }
}

// A mark as a picture as small as it is: copying it takes a tenth of the time that drawing its lines takes.
const stamps = new Map();
function stampOf(kind, color) {
  const name = `${kind} ${color} ${devicePixelRatio}`;
  if (stamps.has(name)) return stamps.get(name);
  const side = 2 * Math.ceil((REACH[kind] * SIZE + 1) * devicePixelRatio);
  const sheet = new OffscreenCanvas(side, side), pen = sheet.getContext("2d", { willReadFrequently: true });
  pen.scale(devicePixelRatio, devicePixelRatio);
  pen.strokeStyle = color;
  pen.lineWidth = 1.3;
  pen.setLineDash(kind === "windows" ? [3, 3] : []);
  SHAPES[kind](pen, side / 2 / devicePixelRatio, side / 2 / devicePixelRatio);
  pen.stroke();
  stamps.set(name, sheet.transferToImageBitmap());
  return stamps.get(name);
}

// Names without overlap: to the right, left, above or below of a light, or none. Earlier lights choose first.
// kept: boxes [left, top, right, bottom] that stay free
export function drawNames(pen, names, toScreen, [width, height], color, kept = []) {
  pen.font = `${FONT}px ui-monospace, monospace`;
  const taken = [...kept, ...names.map(([x, y]) => around(toScreen(x, y), 0.9 * SIZE))];
  for (const [x, y, name] of names) {
    const [left, base] = toScreen(x, y), gap = 2.1 * SIZE, wide = LETTER * FONT * name.length;
    if (left < 0 || base < 0 || left > width || base > height) continue;
    const places = [
      [left + gap, base + 0.35 * FONT], [left - gap - wide, base + 0.35 * FONT],
      [left - wide / 2, base - gap], [left - wide / 2, base + gap + 0.7 * FONT],
    ];
    for (const place of places) {
      const at = [Math.min(Math.max(place[0], 0), width - wide), Math.min(Math.max(place[1], FONT), height - 3)];
      const box = [at[0], at[1] - 0.8 * FONT, at[0] + wide, at[1] + 2];
      if (taken.some((other) => overlap(box, other))) continue;
      taken.push(box);
      write(pen, name, at, color);
      break;
    }
  }
}

const around = ([x, y], half) => [x - half, y - half, x + half, y + half];
const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

// Text on a dark ground, readable over a bright sky.
export function write(pen, text, [x, y], color) {
  pen.font = `${FONT}px ui-monospace, monospace`;
  pen.fillStyle = "rgb(13 16 21 / 65%)";
  pen.fillRect(x - 1, y - 0.8 * FONT, LETTER * FONT * text.length + 2, FONT);
  pen.fillStyle = color;
  pen.fillText(text, x, y);
}

// The factor by which residuals are enlarged so that their median has a wanted length, the next greater of 1, 2, 5 times
// a power of ten; the longest residual that is drawn in full, so that a wrong match does not cover the others; and both
// in words.
const LONGEST = 8, LEAST_PX = 1e-6;
export function arrowScale(lengths, wanted) {
  if (!lengths.length) return { factor: 1, longest: 1, text: "" };
  const sorted = [...lengths].sort((a, b) => a - b), half = (sorted.length - 1) / 2;
  const median = (sorted[Math.floor(half)] + sorted[Math.ceil(half)]) / 2, least = wanted / Math.max(median, LEAST_PX);
  const decade = 10 ** Math.floor(Math.log10(least)), factor = [1, 2, 5, 10].find((step) => step * decade >= least) * decade;
  const longest = LONGEST * Math.max(median, LEAST_PX), cut = lengths.filter((length) => length > longest).length;
  const shortened = cut ? `; ${cut} shortened, up to ${sorted.at(-1).toPrecision(3)} px` : "";
  const text = `arrows × ${Number(factor.toPrecision(1))}, median ${median.toPrecision(3)} px of ${lengths.length}${shortened}`;
  return { factor, longest, text };
}

// Residuals [x, y, along x, along y] as arrows, and their scale at the lower edge, which is returned. wide: of the frame
const ARROW = "#70c0f0", SHORTENED = "#ffab1a", HEAD = 4, SHARE = 0.025; // least median arrow over the frame's width
export function drawArrows(pen, residuals, wide, toScreen, [, height]) {
  const lengths = residuals.map(([, , dx, dy]) => Math.hypot(dx, dy));
  const { factor, longest, text } = arrowScale(lengths, SHARE * wide);
  residuals.forEach(([x, y, dx, dy], n) => {
    const isShortened = lengths[n] > longest, scale = isShortened ? (factor * longest) / lengths[n] : factor;
    const from = toScreen(x, y), to = toScreen(x + scale * dx, y + scale * dy), turn = Math.atan2(to[1] - from[1], to[0] - from[0]);
    const barbs = [2.6, -2.6].map((side) => [to[0] + HEAD * Math.cos(turn + side), to[1] + HEAD * Math.sin(turn + side)]);
    for (const [color, wide] of [["rgb(13 16 21 / 80%)", 3.6], [isShortened ? SHORTENED : ARROW, 1.6]]) {
      pen.strokeStyle = color;
      pen.lineWidth = wide;
      pen.beginPath();
      pen.moveTo(...from);
      pen.lineTo(...to);
      pen.moveTo(...barbs[0]);
      pen.lineTo(...to);
      pen.lineTo(...barbs[1]);
      pen.stroke();
    }
  });
  if (text) write(pen, text, [6, height - 6], ARROW);
  return text;
}

export function drawGrid(pen, lines, toScreen, [width, height], color) {
  pen.strokeStyle = color;
  pen.lineWidth = 1;
  for (const { path, label } of lines) {
    pen.beginPath();
    let end = null;
    for (const [x0, y0, x1, y1] of path) {
      const from = toScreen(x0 - 0.5, y0 - 0.5), to = toScreen(x1 - 0.5, y1 - 0.5);
      pen.moveTo(...from);
      pen.lineTo(...to);
      if (to[0] > 4 && to[1] > FONT && to[0] < width - 50 && to[1] < height - 4) end ??= to;
    }
    pen.stroke();
    if (end) write(pen, label, [end[0] + 3, end[1] - 2], "#a9bdd8");
  }
}

// A ring about the light that is hovered or selected, here or elsewhere on the page.
export function drawHighlight(pen, [x, y], color) {
  pen.strokeStyle = color;
  pen.lineWidth = 2.5;
  pen.beginPath();
  pen.arc(x, y, 2.6 * SIZE, 0, 2 * Math.PI);
  pen.stroke();
}

// Enlarged pixels with their values, and crosses at the centroids. window: {x, y, across, down, dn} of its pixels
export function drawLoupe(pen, window, gray, crosses, [width, height], color) {
  const cell = Math.min(width / window.across, height / window.down);
  pen.clearRect(0, 0, width, height);
  pen.textAlign = "center";
  const digits = Math.max(...window.dn.map((value) => value.toFixed(0).length));
  pen.font = `${Math.min(0.46 * cell, (0.94 * cell) / (LETTER * digits))}px ui-monospace, monospace`;
  window.dn.forEach((value, n) => {
    const x = (n % window.across) * cell, y = Math.floor(n / window.across) * cell, shade = gray(value);
    pen.fillStyle = `rgb(${shade},${shade},${shade})`;
    pen.fillRect(x, y, cell + 0.5, cell + 0.5);
    pen.fillStyle = shade > 120 ? "#000" : "#b6bfcd";
    pen.fillText(value.toFixed(0), x + cell / 2, y + 0.64 * cell);
  });
  pen.textAlign = "left";
  pen.strokeStyle = color;
  pen.lineWidth = 1.5;
  for (const [x, y] of crosses) {
    const along = (x - window.x + 0.5) * cell, down = (y - window.y + 0.5) * cell;
    if (along < 0 || down < 0 || along > window.across * cell || down > window.down * cell) continue;
    pen.beginPath();
    pen.moveTo(along - 8, down);
    pen.lineTo(along + 8, down);
    pen.moveTo(along, down - 8);
    pen.lineTo(along, down + 8);
    pen.stroke();
  }
}
