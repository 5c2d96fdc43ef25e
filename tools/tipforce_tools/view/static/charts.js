// Strip charts of P, phi and theta, from bins with minimum, maximum and uncertainty.
import { K, QUANTITIES, clock, nice, number } from "./format.js";
import { colour, font } from "./theme.js";

const FIELDS = 10; // per finger: low x 3, high x 3, u x 3, unknown rows

// The bins of all fingers, by their number: time = number x width.
export class Bins {
  constructor(widthMs) {
    this.widthMs = widthMs;
    this.rows = new Map();
    this.keys = null; // sorted bin numbers, if computed
  }

  add(bins) {
    bins.i.forEach((index, n) => this.set(index, bins.v[n]));
  }

  set(index, row) {
    if (!this.rows.has(index)) this.keys = null;
    this.rows.set(index, row);
  }

  // Calls with (time, row) for each bin of a span, in the order of time.
  each(fromMs, toMs, call) {
    this.keys ??= [...this.rows.keys()].sort((a, b) => a - b);
    for (const index of this.keys) {
      const t = index * this.widthMs;
      if (t >= fromMs - this.widthMs && t <= toMs) call(t, this.rows.get(index));
    }
  }

  prune(firstMs) {
    const first = Math.floor(firstMs / this.widthMs) - 2;
    for (const index of this.rows.keys()) {
      if (index < first) {
        this.rows.delete(index);
        this.keys = null;
      }
    }
  }

  // [{t, low, high, u, unknown}] of one quantity of one finger, in the order of time; low is null where unknown.
  series(finger, quantity, fromMs, toMs) {
    const found = [], base = finger * FIELDS;
    this.each(fromMs, toMs, (t, row) => {
      if (row.length < base + FIELDS) return;
      found.push({
        t, low: row[base + quantity], high: row[base + 3 + quantity], u: row[base + 6 + quantity], unknown: row[base + 9],
      });
    });
    return found;
  }
}

export const LEFT = 46;
const ANGLES = [1, 2, 5, 10, 15, 30, 45, 90];

// options: {bins, fingers, chosen, quantity, from, to, periodMs, events, axis}
export function drawChart(context, options, x, y, width, height) {
  const { bins, fingers, chosen, quantity, from, to, axis } = options;
  const what = QUANTITIES[quantity];
  const bottom = y + height - (axis ? 24 : 8), top = y + 16, left = x + LEFT, right = x + width - 4;
  const series = bins.series(chosen, quantity, from, to);
  const [least, most, step] = range(options, series);
  const px = (t) => left + ((t - from) / (to - from)) * (right - left);
  const py = (value) => bottom - ((value - least) / (most - least)) * (bottom - top);
  context.save();
  context.font = `11px ${font.family}`;
  grid(context, { left, right, least, most, step, py, digits: step < 0.1 ? 2 : step < 1 ? 1 : 0 });
  if (axis) timeAxis(context, { left, right, from, to, px, bottom });
  context.beginPath();
  context.rect(left, top - 6, right - left, bottom - top + 12);
  context.clip();
  const joint = 2.5 * options.periodMs + 1.1 * bins.widthMs; // the time of a bin is known to its width
  others(context, options, joint, px, py);
  const w = Math.max(1, px(from + bins.widthMs) - left);
  band(context, series, joint, px, py, w);
  envelope(context, series, px, py, w);
  line(context, series, joint, px, py, colour.select, 1.6);
  gaps(context, series, px, bottom, w);
  marks(context, options.events, chosen, fingers, px, from, to, top, bottom);
  context.restore();
  context.font = `600 12px ${font.family}`;
  context.fillStyle = colour.ink;
  context.textAlign = "left";
  context.textBaseline = "alphabetic";
  context.fillText(`${what.symbol} in ${what.unit === "\u00b0" ? "degrees" : what.unit}`, left, y + 10);
}

function range({ bins, fingers, quantity, from, to }, series) {
  let least = Infinity, most = -Infinity;
  bins.each(from, to, (_, row) => {
    for (let n = 0; n < fingers.length; n += 1) {
      const low = row[n * FIELDS + quantity] ?? null, high = row[n * FIELDS + 3 + quantity];
      if (low === null) continue;
      if (low < least) least = low;
      if (high > most) most = high;
    }
  });
  for (const { low, high, u } of series) {
    if (low === null || u === null) continue;
    const extra = Math.min(K * u, 30);
    least = Math.min(least, low - extra);
    most = Math.max(most, high + extra);
  }
  if (!Number.isFinite(least)) [least, most] = quantity ? [0, 180] : [0, 1];
  // A force is not negative, even if its band extends below zero.
  if (quantity === 0) least = 0;
  const span = Math.max(most - least, QUANTITIES[quantity].least);
  const step = quantity ? ANGLES.find((angle) => angle >= span / 4) ?? 90 : nice(span / 4);
  if (quantity) [least, most] = [Math.max(least, -180), Math.min(most, 180)];
  const bottom = Math.floor(least / step + 1e-9) * step;
  return [bottom, Math.max(Math.ceil(most / step - 1e-9) * step, bottom + step), step];
}

function grid(context, { left, right, least, most, step, py, digits }) {
  context.strokeStyle = colour.line;
  context.fillStyle = colour.soft;
  context.lineWidth = 1;
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (let value = least; value <= most + step / 2; value += step) {
    const at = Math.round(py(value)) + 0.5;
    context.beginPath();
    context.moveTo(left, at);
    context.lineTo(right, at);
    context.stroke();
    context.fillText(number(value, digits), left - 6, at);
  }
}

function timeAxis(context, { left, right, from, to, px, bottom }) {
  const step = nice((to - from) / 1000 / 5) * 1000;
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

// The other fingers, thin: all in one path.
function others(context, { bins, fingers, chosen, quantity, from, to }, joint, px, py) {
  context.strokeStyle = colour.other;
  context.lineWidth = 1;
  context.beginPath();
  for (let n = 0; n < fingers.length; n += 1) {
    if (n === chosen) continue;
    const low = n * FIELDS + quantity, high = low + 3;
    let last = -Infinity;
    bins.each(from, to, (t, row) => {
      if ((row[low] ?? null) === null) return;
      const x = px(t), y = py((row[low] + row[high]) / 2);
      if (t - last > joint) context.moveTo(x, y);
      else context.lineTo(x, y);
      last = t;
    });
  }
  context.stroke();
}

function line(context, series, joint, px, py, style, width) {
  context.strokeStyle = style;
  context.lineWidth = width;
  context.beginPath();
  for (const run of runs(series, joint)) {
    run.forEach((bin, n) => {
      const at = [px(bin.t), py((bin.low + bin.high) / 2)];
      if (n) context.lineTo(...at);
      else context.moveTo(...at);
    });
    if (run.length === 1) context.lineTo(px(run[0].t) + 1.5, py((run[0].low + run[0].high) / 2));
  }
  context.stroke();
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

function envelope(context, series, px, py, width) {
  context.fillStyle = colour.select;
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

function marks(context, events, chosen, fingers, px, from, to, top, bottom) {
  context.strokeStyle = colour.bad;
  context.setLineDash([3, 3]);
  context.lineWidth = 1;
  for (const event of events) {
    if (event.t < from || event.t > to || !isBad(event) || (event.node && event.node !== fingers[chosen]?.node_id)) continue;
    context.beginPath();
    context.moveTo(px(event.t), top);
    context.lineTo(px(event.t), bottom);
    context.stroke();
  }
  context.setLineDash([]);
}

export const isBad = (event) => ["emcy", "heartbeat_lost", "bus_down", "failed"].includes(event.kind);
