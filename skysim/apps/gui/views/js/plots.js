// The plot under the frame: a histogram with the two display limits, or the profile of a cut.

const MARGIN = { left: 4, right: 4, top: 16, bottom: 16 };
const PEAK = "#6ff0d8", FULL = "#dd5a60";
const QUIET = "#8b95a5", BAR = "#62758f", LIMIT = "#f0b429";

// The axis is an inverse hyperbolic sine about the sky, in units of its scatter, see `histogram` in worker/pixels.py.
const AXIS_MARGIN = 0.3;

function axisOf({ sky, scatter, range }, width) {
  const bend = (level) => Math.asinh((level - sky) / scatter), inner = width - MARGIN.left - MARGIN.right;
  const [first, last] = [bend(range[0]) - AXIS_MARGIN, bend(range[1]) + AXIS_MARGIN];
  return {
    at: (level) => MARGIN.left + ((bend(level) - first) / (last - first)) * inner,
    level: (x) => sky + scatter * Math.sinh(first + ((x - MARGIN.left) / inner) * (last - first)),
  };
}

// well: [electrons per digital number, bias in digital numbers, electrons of a full well], of a scene's detector;
// peaks: the brightest pixel of each light, in levels, drawn as ticks over the bars
export function drawHistogram(pen, { pixels, histogram, well }, levels, [width, height], peaks) {
  const axis = axisOf(histogram, width), { counts } = histogram;
  const most = Math.log1p(Math.max(...counts)), room = height - MARGIN.top - MARGIN.bottom;
  pen.clearRect(0, 0, width, height);
  pen.fillStyle = BAR;
  const wide = (width - MARGIN.left - MARGIN.right) / counts.length;
  counts.forEach((count, n) => {
    const tall = (Math.log1p(count) / most) * room;
    pen.fillRect(MARGIN.left + n * wide, height - MARGIN.bottom - tall, wide + 0.3, tall);
  });
  pen.font = "11px ui-monospace, monospace";
  levels.forEach((level, n) => {
    const x = Math.min(Math.max(axis.at(level), 1), width - 1), dn = pixels.offset + pixels.step * level;
    pen.fillStyle = LIMIT;
    pen.fillRect(x - 1, MARGIN.top - 2, 2, room + 4);
    pen.textAlign = n ? "right" : "left";
    pen.fillText(dn.toFixed(0), n ? width - MARGIN.right : MARGIN.left, height - 3);
  });
  pen.textAlign = "left";
  pen.fillStyle = QUIET;
  if (!well) {
    pen.fillText("drag the limits", MARGIN.left, 11);
    return axis;
  }
  const [, , full] = well, inElectrons = (level) => electrons(pixels.offset + pixels.step * level, well);
  pen.fillStyle = PEAK;
  for (const peak of peaks) pen.fillRect(axis.at(peak) - 0.5, MARGIN.top, 1.5, 7);
  const brightest = inElectrons(Math.max(histogram.range[1], ...peaks));
  pen.fillStyle = QUIET;
  pen.fillText(`${brief(brightest)} e⁻ of ${brief(full)}: ${((100 * brightest) / full).toPrecision(3)} %`, MARGIN.left, 11, width - 2 * MARGIN.left);
  const at = axis.at((full / well[0] + well[1] - pixels.offset) / pixels.step);
  pen.fillStyle = FULL;
  if (at < width) pen.fillRect(at - 1, MARGIN.top, 2, room); // the full well
  return axis;
}

export const electrons = (dn, [gain, bias]) => Math.max(0, gain * (dn - bias));
export const brief = (e) =>
  e < 1e4 ? e.toFixed(0) : e < 999.5e3 ? `${(e / 1e3).toPrecision(3)} k` : `${(e / 1e6).toPrecision(3)} M`;

// Which of the two limits is nearer to a place on the axis.
export function nearestLevel(axis, levels, x) {
  return Math.abs(axis.at(levels[0]) - x) <= Math.abs(axis.at(levels[1]) - x) ? 0 : 1;
}

export const levelAt = (axis, x) => axis.level(x);

export function drawProfile(pen, { length, values }, [width, height], color) {
  const low = Math.min(...values), high = Math.max(...values), range = Math.max(high - low, 1);
  const room = height - MARGIN.top - MARGIN.bottom, wide = width - MARGIN.left - MARGIN.right;
  pen.clearRect(0, 0, width, height);
  pen.strokeStyle = color;
  pen.lineWidth = 1.3;
  pen.beginPath();
  values.forEach((dn, n) => {
    const x = MARGIN.left + (n / Math.max(values.length - 1, 1)) * wide, y = MARGIN.top + (1 - (dn - low) / range) * room;
    if (n) pen.lineTo(x, y);
    else pen.moveTo(x, y);
  });
  pen.stroke();
  pen.font = "11px ui-monospace, monospace";
  pen.fillStyle = QUIET;
  pen.fillText(`cut: ${low.toFixed(0)} to ${high.toFixed(0)} DN`, MARGIN.left, 11);
  pen.textAlign = "right";
  pen.fillText(`${length.toFixed(1)} px`, width - MARGIN.right, height - 3);
  pen.textAlign = "left";
}
