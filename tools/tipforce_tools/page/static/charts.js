// Strip charts of curves: bins with minimum, maximum and uncertainty, the name at each curve's end.
import { K, clock, nice, number } from "./format.js";
import { colour, font } from "./theme.js";

export const LEFT = 46, RIGHT = 62; // pixels for the values and for the names of the curves
const ANGLES = [1, 2, 5, 10, 15, 30, 45, 90];
const LINE = 12; // height of a name

// options: {bins, curves, title, unit, digits, range, least, from, to, periodMs, events, node, axis, cursor, pointer}
// A curve is {name, finger, quantity, colour, main}; range is [lowest, highest], or null to fit the values.
export function drawChart(context, options, x, y, width, height) {
  const { bins, curves, from, to, axis } = options;
  const bottom = y + height - (axis ? 24 : 8), top = y + 16, left = x + LEFT, right = x + width - RIGHT;
  // A series has an object for each bin: only for the main curves.
  const lay = (turn) => curves.map((curve) => ({ ...curve, turn })).map((curve) => (
    { ...curve, series: curve.main ? bins.series(curve, from, to) : null, ...limits(bins, curve, from, to) }));
  // Angles are shown from -180 to 180 or from 0 to 360 degrees: 179 and -179 are 2 degrees apart.
  const plain = lay(0), turned = options.degrees && span(plain) > 180 ? lay(360) : plain;
  const drawn = span(turned) < span(plain) ? turned : plain;
  const [least, most, step] = range(options, drawn);
  const px = (t) => left + ((t - from) / (to - from)) * (right - left);
  const py = (value) => bottom - ((value - least) / (most - least)) * (bottom - top);
  context.save();
  context.font = `11px ${font.family}`;
  grid(context, { left, right, least, most, step, py, digits: step < 0.1 ? 2 : step < 1 ? 1 : 0, degrees: options.degrees });
  if (axis) timeAxis(context, { left, right, from, to, px, bottom });
  context.beginPath();
  context.rect(left, top - 6, right - left, bottom - top + 12);
  context.clip();
  const joint = 2.5 * options.periodMs + 1.1 * bins.widthMs; // the time of a bin is known to its width
  const w = Math.max(1, px(from + bins.widthMs) - left);
  for (const curve of drawn) {
    if (curve.main) {
      band(context, curve.series, joint, px, py, w);
      envelope(context, curve, px, py, w);
    }
    line(context, bins, curve, from, to, joint, px, py);
  }
  const [first] = drawn.filter((curve) => curve.main);
  if (first) gaps(context, first.series, px, bottom, w);
  marks(context, options, px, top, bottom);
  if (options.selected) {
    const [a, b] = options.selected.map(px);
    context.fillStyle = colour.select;
    context.globalAlpha = 0.15;
    context.fillRect(Math.min(a, b), top, Math.abs(b - a), bottom - top);
    context.globalAlpha = 1;
  }
  if (options.cursor !== null) upright(context, px(options.cursor), top, bottom, colour.ink, 1.4);
  if (options.pointer !== null) upright(context, px(options.pointer), top, bottom, colour.soft, 1);
  context.restore();
  names(context, drawn, py, right, top, bottom, most, least);
  heading(context, options, drawn, joint, left, y + 10, x + width - 2, most, least);
}

const span = (drawn) => Math.max(...drawn.map(({ highest }) => highest)) - Math.min(...drawn.map(({ lowest }) => lowest));

// The extremes of a curve, and its last value.
function limits(bins, curve, from, to) {
  let lowest = Infinity, highest = -Infinity, last = null;
  bins.values(curve, from, to, (_, low, high) => {
    if (low === null) return;
    if (low < lowest) lowest = low;
    if (high > highest) highest = high;
    last = (low + high) / 2;
  });
  return { lowest, highest, last };
}

export function segment(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

function upright(context, at, top, bottom, style, width) {
  context.strokeStyle = style;
  context.lineWidth = width;
  segment(context, Math.round(at) + 0.5, top - 4, Math.round(at) + 0.5, bottom + 4);
}

// The name of each curve, at the height of its last value; names that would overlap are moved apart.
function names(context, drawn, py, right, top, bottom, most, least) {
  const places = [];
  for (const curve of drawn) {
    if (curve.last === null) continue;
    const value = Math.min(most, Math.max(least, curve.last));
    places.push({ curve, y: py(value), end: py(value) });
  }
  places.sort((a, b) => a.y - b.y);
  places.forEach((place, n) => { if (n) place.y = Math.max(place.y, places[n - 1].y + LINE); });
  let limit = bottom + 4;
  for (const place of places.toReversed()) {
    place.y = Math.min(place.y, limit);
    limit = place.y - LINE;
  }
  context.textAlign = "left";
  context.textBaseline = "middle";
  for (const { curve, y, end } of places) {
    context.strokeStyle = curve.colour;
    context.lineWidth = 0.8;
    segment(context, right, end, right + 6, y);
    context.font = `${curve.main ? "600 " : ""}11px ${font.family}`;
    context.fillStyle = curve.colour;
    context.fillText(curve.name, right + 8, y, RIGHT - 8);
  }
}

// The title, and the values under the pointer.
function heading(context, options, drawn, joint, left, baseline, right, most, least) {
  context.font = `600 12px ${font.family}`;
  context.fillStyle = colour.ink;
  context.textAlign = "left";
  context.textBaseline = "alphabetic";
  context.fillText(options.title, left, baseline);
  let at = left + context.measureText(options.title).width + 14;
  const beyond = drawn.some(({ lowest, highest }) => highest > most + 1e-9 || lowest < least - 1e-9);
  if (beyond && options.range) {
    context.fillStyle = colour.bad;
    context.fillText("beyond the scale", at, baseline);
    at += context.measureText("beyond the scale").width + 14;
  }
  if (options.pointer === null) return;
  context.font = `12px ${font.family}`;
  const words = [[clock(options.pointer, 2), colour.soft]];
  const order = [...drawn.filter((curve) => curve.main), ...drawn.filter((curve) => !curve.main)];
  for (const curve of order) words.push([`${curve.name} ${reading(options.bins.nearest(curve, options.pointer, joint), options)}`, curve.colour]);
  for (const [text, style] of words) {
    const width = context.measureText(text).width;
    if (at + width > right) return;
    context.fillStyle = style;
    context.fillText(text, at, baseline);
    at += width + 12;
  }
}

function reading(bin, { digits, degrees }) {
  if (!bin) return "unknown";
  const spread = bin.u === null ? "" : ` \u00b1 ${number(K * bin.u, digits)}`;
  const [low, high] = [bin.low, bin.high].map((value) => number(degrees ? within180(value) : value, digits));
  return (low === high ? low : `${low} to ${high}`) + spread;
}

function range({ range: fixed, least: smallest, degrees }, drawn) {
  if (fixed) {
    const step = nice((fixed[1] - fixed[0]) / (fixed[0] < 0 ? 4 : 5));
    return [fixed[0], fixed[1], step];
  }
  let least = Math.min(...drawn.map(({ lowest }) => lowest)), most = Math.max(...drawn.map(({ highest }) => highest));
  for (const { low, high, u } of drawn.flatMap(({ series }) => series ?? [])) {
    if (low === null || u === null) continue;
    const extra = Math.min(K * u, 30);
    least = Math.min(least, low - extra);
    most = Math.max(most, high + extra);
  }
  if (!Number.isFinite(least)) [least, most] = [0, 180];
  const step = degrees ? ANGLES.find((angle) => angle >= Math.max(most - least, smallest) / 4) ?? 90 : nice(Math.max(most - least, smallest) / 4);
  const { turn = 0 } = drawn[0] ?? {};
  [least, most] = [Math.max(least, turn / 2 - 180), Math.min(most, turn / 2 + 180)];
  const bottom = Math.floor(least / step + 1e-9) * step;
  return [bottom, Math.max(Math.ceil(most / step - 1e-9) * step, bottom + step), step];
}

const within180 = (degrees) => (degrees > 180 ? degrees - 360 : degrees);
function grid(context, { left, right, least, most, step, py, digits, degrees }) {
  context.strokeStyle = colour.line;
  context.fillStyle = colour.soft;
  context.lineWidth = 1;
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (let value = least; value <= most + step / 2; value += step) {
    const at = Math.round(py(value)) + 0.5;
    segment(context, left, at, right, at);
    context.fillText(number(degrees ? within180(value) : value, digits), left - 6, at);
  }
}

function timeAxis(context, { left, right, from, to, px, bottom }) {
  const step = nice((to - from) / 1000 / Math.max(2, Math.min(8, (right - left) / 110))) * 1000;
  context.textBaseline = "top";
  for (let t = Math.ceil(from / step) * step; t <= to; t += step) {
    const at = px(t);
    context.fillRect(Math.round(at), bottom, 1, 4);
    context.textAlign = at > right - 30 ? "right" : at < left + 30 ? "left" : "center";
    context.fillText(clock(t, step < 1000 ? 1 : 0), at, bottom + 8);
  }
}

// Runs of adjacent known bins: gaps are not drawn.
function* runs(series, joint) {
  let run = [];
  for (const bin of series) {
    if (run.length && (bin.low === null || bin.t - run[run.length - 1].t > joint)) {
      yield run;
      run = [];
    }
    if (bin.low !== null) run.push(bin);
  }
  if (run.length) yield run;
}

function line(context, bins, curve, from, to, joint, px, py) {
  context.strokeStyle = curve.colour;
  context.lineWidth = curve.main ? 2.2 : 1.2;
  context.setLineDash(curve.dashed ? [5, 3] : []);
  context.beginPath();
  let before = -Infinity;
  bins.values(curve, from, to, (t, low, high) => {
    if (low === null) {
      before = -Infinity;
      return;
    }
    const x = px(t), y = py((low + high) / 2);
    if (t - before > joint) {
      context.moveTo(x, y);
      context.lineTo(x + 1.5, y); // a single bin is a dot
      context.moveTo(x, y);
    } else context.lineTo(x, y);
    before = t;
  });
  context.stroke();
  context.setLineDash([]);
}

function band(context, series, joint, px, py, width) {
  context.fillStyle = colour.cone;
  context.globalAlpha = 0.3;
  for (const run of runs(series, joint)) {
    const known = run.filter((bin) => bin.u !== null);
    if (!known.length) continue;
    context.beginPath();
    known.forEach((bin) => context.lineTo(px(bin.t), py(bin.high + K * bin.u)));
    const last = known[known.length - 1];
    context.lineTo(px(last.t) + width, py(last.high + K * last.u));
    context.lineTo(px(last.t) + width, py(last.low - K * last.u));
    known.reverse().forEach((bin) => context.lineTo(px(bin.t), py(bin.low - K * bin.u)));
    context.fill();
  }
  context.globalAlpha = 1;
}

function envelope(context, { series, colour: style }, px, py, width) {
  context.fillStyle = style;
  context.globalAlpha = 0.55;
  for (const { t, low, high } of series) {
    if (low !== null && high > low) context.fillRect(px(t), py(high), width, py(low) - py(high));
  }
  context.globalAlpha = 1;
}

function gaps(context, series, px, bottom, width) {
  context.fillStyle = colour.bad;
  for (const { t, unknown } of series) if (unknown > 0) context.fillRect(px(t), bottom + 1, Math.max(width, 1), 4);
}

function marks(context, { events, node, from, to }, px, top, bottom) {
  context.strokeStyle = colour.bad;
  context.setLineDash([3, 3]);
  context.lineWidth = 1;
  for (const event of events) {
    if (event.t < from || event.t > to || !isBad(event) || (event.node && event.node !== node)) continue;
    segment(context, px(event.t), top, px(event.t), bottom);
  }
  context.setLineDash([]);
}

export const isBad = (event) => ["emcy", "heartbeat_lost", "bus_down", "failed", "duplicate"].includes(event.kind);
