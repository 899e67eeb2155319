// Pixels of a frame: decoding, colors, and the profile of a cut.

const HEADER_BYTES = 16, LENGTH_BYTES = 4;
// Inverse of the curves of the display: fraction of the limits' range at a brightness from 0 to 1.
const INVERSE = {
  linear: (brightness) => brightness,
  "square root": (brightness) => brightness ** 2,
  logarithm: (brightness) => (201 ** brightness - 1) / 200, // of log(1 + 200 fraction) / log(201)
};

// Two float64 (offset, step), then an unsigned integer n per pixel, of 8 or 16 bits: its value is offset + step n. If the
// frame is shaded, there are fewer pixels than it has, and n is the shade of the mean over an area. Then come the frame's
// fields as JSON, and the length of that, 32 bits.
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(buffer.byteLength - LENGTH_BYTES, true);
  const end = buffer.byteLength - LENGTH_BYTES - length;
  const fields = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, end, length)));
  const [width, height] = fields.grid, [offset, step] = new Float64Array(buffer, 0, 2);
  const Kind = end - HEADER_BYTES === width * height ? Uint8Array : Uint16Array;
  const data = new Kind(buffer, HEADER_BYTES, (end - HEADER_BYTES) / Kind.BYTES_PER_ELEMENT);
  if (data.length !== width * height) throw new Error("the pixels do not fit the frame's size");
  return { ...fields, pixels: { data, offset, step, width, height }, isWhole: !fields.shaded };
}

// A function that returns the next bytes of a stream, as many as asked for; null at its end.
export function reader(source) {
  let rest = new Uint8Array(0);
  return async (size) => {
    const bytes = new Uint8Array(size);
    for (let at = 0; at < size; ) {
      if (!rest.length) {
        const { done, value } = await source.read();
        if (done) return null;
        rest = value;
      }
      const part = rest.subarray(0, size - at);
      bytes.set(part, at);
      at += part.length;
      rest = rest.subarray(part.length);
    }
    return bytes.buffer;
  };
}

// A color map from a base64 string of 256 x (red, green, blue): one 32-bit pixel per entry.
export function palette(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return Uint32Array.from({ length: 256 }, (_, n) => rgb(bytes[3 * n], bytes[3 * n + 1], bytes[3 * n + 2]));
}

const rgb = (red, green, blue) => ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
const WARNING = rgb(255, 60, 60);

// A 32-bit pixel for every stored integer up to `highest`; those from `saturation` on get the warning color.
export function colorTable(highest, [low, high], curve, colors, saturation) {
  const table = new Uint32Array(highest + 1), range = Math.max(high - low, 1e-9), inverse = INVERSE[curve];
  const first = (shade) => Math.max(Math.ceil(low + range * inverse((shade - 0.5) / 255)), 0); // of a shade, rounded
  table.fill(colors[0]);
  for (let shade = 1; shade < 256; shade++) table.fill(colors[shade], first(shade), shade < 255 ? first(shade + 1) : undefined);
  if (saturation <= highest) table.fill(WARNING, Math.max(Math.ceil(saturation), 0));
  return table;
}

// A 32-bit pixel for every shade: from black to white, then the warning color of saturated areas.
export function shadeTable(colors) {
  const table = Uint32Array.from({ length: 256 }, (_, n) => colors[Math.round((n * 255) / 254)]);
  table[255] = WARNING;
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
