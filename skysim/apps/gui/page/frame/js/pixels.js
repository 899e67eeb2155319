// Pixels of a frame: decoding, display limits, histogram and colors.

const HEADER_BYTES = 16, LENGTH_BYTES = 4;
const ZSCALE = { samples: 1000, contrast: 0.25, maxReject: 0.5, minPixels: 5, krej: 2.5, iterations: 5 };
const STRIDE = 8; // in rows and columns, of the sample for limits and histogram
export const CURVES = {
  linear: (fraction) => fraction,
  "square root": Math.sqrt,
  logarithm: (fraction) => Math.log1p(200 * fraction) / Math.log1p(200),
};

// Two float64 (offset, step), then an unsigned integer n per pixel, of 8 or 16 bits: its value is offset + step n. Then
// the frame's fields as JSON, and the length of that, 32 bits.
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(buffer.byteLength - LENGTH_BYTES, true);
  const end = buffer.byteLength - LENGTH_BYTES - length;
  const fields = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, end, length)));
  const [width, height] = fields.size, [offset, step] = new Float64Array(buffer, 0, 2);
  const Kind = end - HEADER_BYTES === width * height ? Uint8Array : Uint16Array;
  const data = new Kind(buffer, HEADER_BYTES, (end - HEADER_BYTES) / Kind.BYTES_PER_ELEMENT);
  if (data.length !== width * height) throw new Error("the pixels do not fit the frame's size");
  return { fields, pixels: { data, offset, step, width, height } };
}

// Sorted sample of the pixels, with the extreme values of all of them.
export function sample({ data, width, height }) {
  const sampled = new data.constructor(Math.ceil(width / STRIDE) * Math.ceil(height / STRIDE));
  let count = 0, low = data[0], high = data[0];
  for (let y = 0; y < height; y += STRIDE) for (let x = 0; x < width; x += STRIDE) sampled[count++] = data[y * width + x];
  for (let n = 0; n < data.length; n++) {
    const value = data[n];
    if (value > high) high = value;
    else if (value < low) low = value;
  }
  return { sorted: sampled.sort(), low, high };
}

function quantile(sorted, fraction) {
  const at = fraction * (sorted.length - 1), n = Math.floor(at);
  return sorted[n] + (at - n) * ((sorted[n + 1] ?? sorted[n]) - sorted[n]);
}

// Black and white level by name, in units of the stored integers.
export const LIMITS = {
  // The sky (30th percentile), and the 99.9th percentile or, if higher, a quarter of the way to the brightest pixel.
  automatic(pixels, { sorted, high }) {
    const low = quantile(sorted, 0.3);
    return [low, Math.max(quantile(sorted, 0.999), low + 0.25 * (high - low))];
  },
  zscale,
  "min to max": (pixels, { low, high }) => [low, high],
};

// IRAF's zscale with the defaults of astropy.visualization.ZScaleInterval: a line is fitted to the sorted sample with
// iterated rejection; its slope over the contrast gives the limits about the median.
export function zscale({ data }) {
  const stride = Math.max(1, Math.floor(data.length / ZSCALE.samples));
  const values = [];
  for (let n = 0; n < data.length && values.length < ZSCALE.samples; n += stride) values.push(data[n]);
  values.sort((a, b) => a - b);
  const count = values.length, grow = Math.max(1, Math.floor(0.01 * count));
  const least = Math.max(ZSCALE.minPixels, Math.floor(count * ZSCALE.maxReject));
  let bad = new Uint8Array(count), good = count, before = count + 1, slope = 0;
  for (let pass = 0; pass < ZSCALE.iterations && good < before && good >= least; pass++) {
    const line = fitLine(values, bad);
    slope = line.slope;
    const flat = values.map((value, n) => value - line.offset - line.slope * n);
    const threshold = ZSCALE.krej * deviation(flat, bad);
    bad = widened(bad.map((was, n) => was | (Math.abs(flat[n]) > threshold)), grow);
    before = good;
    good = count - bad.reduce((sum, is) => sum + is, 0);
  }
  const low = values[0], high = values[count - 1];
  if (good < least) return [low, high];
  const center = Math.floor((count - 1) / 2), median = (values[Math.floor((count - 1) / 2)] + values[count >> 1]) / 2;
  slope /= ZSCALE.contrast;
  return [Math.max(low, median - (center - 1) * slope), Math.min(high, median + (count - center) * slope)];
}

function fitLine(values, bad) {
  let count = 0, meanX = 0, meanY = 0, xx = 0, xy = 0;
  for (let n = 0; n < values.length; n++) if (!bad[n]) { count++; meanX += n; meanY += values[n]; }
  meanX /= count;
  meanY /= count;
  for (let n = 0; n < values.length; n++) {
    if (!bad[n]) { xx += (n - meanX) ** 2; xy += (n - meanX) * (values[n] - meanY); }
  }
  const slope = xy / xx;
  return { slope, offset: meanY - slope * meanX };
}

function deviation(values, bad) {
  const kept = values.filter((_, n) => !bad[n]);
  const mean = kept.reduce((sum, value) => sum + value, 0) / kept.length;
  return Math.sqrt(kept.reduce((sum, value) => sum + (value - mean) ** 2, 0) / kept.length);
}

// Whether any neighbor within a window of `size` is set; the window is placed as by numpy.convolve(mode="same").
function widened(bad, size) {
  const first = Math.floor((size - 1) / 2) - size + 1;
  return bad.map((_, n) => {
    for (let k = n + first; k < n + first + size; k++) if (bad[k]) return 1;
    return 0;
  });
}

// A color map from a base64 string of 256 x (red, green, blue): one 32-bit pixel per entry.
export function palette(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return Uint32Array.from({ length: 256 }, (_, n) => rgb(bytes[3 * n], bytes[3 * n + 1], bytes[3 * n + 2]));
}

const rgb = (red, green, blue) => ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;

// A 32-bit pixel for every stored integer up to `highest`; those from `saturation` on get the warning color.
export function colorTable(highest, [low, high], curve, colors, saturation) {
  const table = new Uint32Array(highest + 1), range = Math.max(high - low, 1e-9), bend = CURVES[curve];
  for (let n = 0; n <= highest; n++) {
    table[n] = colors[Math.round(255 * bend(Math.min(Math.max((n - low) / range, 0), 1)))];
  }
  if (saturation <= highest) table.fill(rgb(255, 60, 60), Math.max(Math.ceil(saturation), 0));
  return table;
}

// Values along a cut from a to b, at steps of a pixel, interpolated bilinearly.
export function profile({ data, offset, step, width, height }, a, b) {
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]), count = Math.max(Math.ceil(length), 1);
  const values = [];
  for (let n = 0; n <= count; n++) {
    const x = Math.min(Math.max(a[0] + ((b[0] - a[0]) * n) / count, 0), width - 1);
    const y = Math.min(Math.max(a[1] + ((b[1] - a[1]) * n) / count, 0), height - 1);
    const x0 = Math.min(Math.floor(x), width - 2), y0 = Math.min(Math.floor(y), height - 2), at = y0 * width + x0;
    const top = data[at] + (x - x0) * (data[at + 1] - data[at]);
    const under = data[at + width] + (x - x0) * (data[at + width + 1] - data[at + width]);
    values.push(offset + step * (top + (y - y0) * (under - top)));
  }
  return { length, values };
}
