// The cross-section of one fingertip, to scale, with its contact. Lengths in mm, y upwards.
import { segment } from "./charts.js";
import { K, signed } from "./format.js";
import { colour, font, strainColour } from "./theme.js";

const FULL = 35; // mm: the length of the full scale of force, and the space above the tip
const HALF = 32, EDGE = 2; // half of the width; an arrow keeps this distance from the edges
const SHAFT = 2.6, HEAD = 7; // of an arrow: thickness, and length of its head
const BASE = 2.6, BELOW = 3; // height of the base, and the lowest point below the vertical beam
const LEG = 2, LEG_TOP = 2.5, SLIT = 0.25, STRIP = 0.8, GAUGE = 1.7;
const RADIANS = Math.PI / 180;

// state: {word, P, phi, theta, uP, uPhi, uTheta, gauges}, angles in degrees, null for unknown.
// scale: {newtons, fullStrain}. The drawing fills width x height at x, y of the context.
export function drawSection(context, geometry, state, scale, x, y, width, height) {
  const { d, r, h1 } = geometry, low = -(d + 0.5 * h1 + BELOW), high = r + FULL + EDGE;
  const k = Math.min(width / (2 * HALF), height / (high - low)), spare = (height / k - (high - low)) / 2;
  const view = {
    context, k,
    half: width / (2 * k), low: low - spare, high: high + spare,
    x: (mm) => x + width / 2 + mm * k,
    y: (mm) => y + (high + spare - mm) * k,
  };
  context.save();
  context.beginPath();
  context.rect(x, y, width, height);
  context.clip();
  context.lineJoin = "round";
  ruler(view, geometry, state, scale);
  body(view, geometry);
  faces(view, geometry, state, scale);
  beams(view, geometry);
  gauges(view, geometry, state, scale);
  if (state.word === "stale") context.globalAlpha = 0.35;
  if (state.P !== null && state.phi !== null) force(view, geometry, state, scale);
  context.restore();
}

// The scale of the arrows at the left edge: a tick for each newton, or for each tenth of the scale.
function ruler(view, { r }, state, { newtons }) {
  const { context } = view, left = view.x(-view.half + EDGE), beyond = state.P > newtons;
  const step = [0.1, 0.2, 0.5, 1, 2, 5, 10].find((size) => newtons / size <= 5.01) ?? newtons / 5;
  context.strokeStyle = context.fillStyle = beyond ? colour.bad : colour.soft;
  context.lineWidth = 1;
  context.font = `${Math.max(10, Math.min(13, 3 * view.k))}px ${font.family}`;
  context.textAlign = "left";
  context.textBaseline = "middle";
  context.beginPath();
  context.moveTo(left, view.y(r));
  context.lineTo(left, view.y(r + FULL));
  for (let value = 0; value <= newtons * 1.001; value += step) {
    const y = view.y(r + (FULL * value) / newtons);
    context.moveTo(left, y);
    context.lineTo(left + 4, y);
  }
  context.stroke();
  context.fillText("0", left + 7, view.y(r));
  context.fillText(beyond ? `more than ${newtons} N` : `${newtons} N`, left + 7, view.y(r + FULL));
}

function path(view, points) {
  const { context } = view;
  context.beginPath();
  points.forEach(([px, py], n) => (n ? context.lineTo(view.x(px), view.y(py)) : context.moveTo(view.x(px), view.y(py))));
  context.closePath();
}

function body(view, { a, d, r, h1 }) {
  const { context } = view;
  const slit = 0.5 * h1 + SLIT, start = Math.asin(LEG_TOP / r), points = [];
  points.push([a, slit], [a, -0.5 * h1], [a + LEG, -0.5 * h1], [a + LEG, LEG_TOP]);
  for (let n = 0; n <= 60; n += 1) {
    const angle = start + ((Math.PI - 2 * start) * n) / 60;
    points.push([r * Math.cos(angle), r * Math.sin(angle)]);
  }
  points.push([-a - LEG, LEG_TOP], [-a - LEG, -0.5 * h1], [-a, -0.5 * h1], [-a, slit]);
  const bottom = -0.5 * h1 - d;
  context.fillStyle = colour.body;
  context.strokeStyle = colour.edge;
  context.lineWidth = 1;
  path(view, points);
  context.fill();
  context.stroke();
  path(view, [[-9, bottom], [9, bottom], [9, bottom - BASE], [-9, bottom - BASE]]);
  context.fill();
  context.stroke();
}

function beams(view, { a, d, h1, h2 }) {
  const { context } = view;
  const tall = Math.max(h1 * view.k, 1.4), wide = Math.max(h2 * view.k, 1.6);
  context.fillStyle = colour.beam;
  context.fillRect(view.x(-a), view.y(0) - tall / 2, 2 * a * view.k, tall);
  context.fillRect(view.x(0) - wide / 2, view.y(-0.5 * h1), wide, d * view.k);
}

// Both surfaces of each beam, coloured by the strain of beam theory for the contact shown.
function faces(view, geometry, state, scale) {
  const { context } = view;
  const { a, d, h1, h2 } = geometry;
  const known = state.P !== null && state.phi !== null && state.theta !== null && state.word !== "stale";
  const phi = state.phi * RADIANS, delta = (state.phi - state.theta) * RADIANS;
  const F = [state.P * Math.sin(phi), state.P * Math.sin(delta), state.P * Math.cos(phi)];
  for (const face of geometry.faces) {
    const [near, far] = face.microstrain_per_newton.map((row) =>
      known ? row.reduce((sum, c, n) => sum + c * F[n], 0) : NaN);
    const sign = face.side === "left" ? -1 : 1;
    const strip = STRIP * view.k;
    let box, gradient;
    if (face.beam === "H") {
      const up = face.face === "upper" ? 1 : -1;
      gradient = context.createLinearGradient(view.x(0), 0, view.x(sign * a), 0);
      const top = up > 0 ? view.y(0.5 * h1) - strip : view.y(-0.5 * h1);
      box = [Math.min(view.x(0), view.x(sign * a)), top, a * view.k, strip];
    } else {
      gradient = context.createLinearGradient(0, view.y(-0.5 * h1), 0, view.y(-0.5 * h1 - d));
      const left = sign > 0 ? view.x(0.5 * h2) : view.x(-0.5 * h2) - strip;
      box = [left, view.y(-0.5 * h1), strip, d * view.k];
    }
    for (let n = 0; n <= 6; n += 1) {
      gradient.addColorStop(n / 6, strainColour(near + ((far - near) * n) / 6, scale.fullStrain));
    }
    context.fillStyle = gradient;
    context.fillRect(...box);
  }
}

function gauges(view, geometry, state, scale) {
  const { context } = view;
  const rows = {};
  context.font = `${Math.max(10.5, Math.min(13, 2.7 * view.k))}px ${font.family}`;
  context.textBaseline = "middle";
  geometry.gauges.forEach((gauge, n) => {
    const value = state.gauges?.[n] ?? null;
    const stale = state.word === "stale";
    const [x0, y0] = gauge.from, [x1, y1] = gauge.to, [ox, oy] = gauge.out;
    const corners = [[x0, y0], [x1, y1], [x1 + ox * GAUGE, y1 + oy * GAUGE], [x0 + ox * GAUGE, y0 + oy * GAUGE]];
    path(view, corners);
    context.fillStyle = value === null ? colour.card : strainColour(value, scale.fullStrain);
    context.fill();
    if (value !== null && value < 0) hatch(view, corners);
    context.strokeStyle = colour.ink;
    context.lineWidth = 1;
    path(view, corners);
    context.stroke();
    label(view, gauge, n, value, stale, rows);
  });
}

// Compression is hatched, so that it differs from tension without colour.
function hatch(view, corners) {
  const { context } = view;
  const xs = corners.map((c) => view.x(c[0])), ys = corners.map((c) => view.y(c[1]));
  const left = Math.min(...xs), right = Math.max(...xs), top = Math.min(...ys), bottom = Math.max(...ys);
  context.save();
  context.clip();
  context.beginPath();
  for (let s = left - (bottom - top); s < right; s += 2.5) {
    context.moveTo(s, bottom);
    context.lineTo(s + bottom - top, top);
  }
  context.strokeStyle = colour.card;
  context.lineWidth = 0.9;
  context.stroke();
  context.restore();
}

function label(view, gauge, n, value, stale, rows) {
  const { context } = view;
  const [x0, y0] = gauge.from, [x1, y1] = gauge.to;
  const sign = gauge.beam === "H" ? Math.sign(x0 + x1) : gauge.out[0];
  const middle = [(x0 + x1) / 2 + gauge.out[0] * GAUGE, (y0 + y1) / 2 + gauge.out[1] * GAUGE];
  const key = `${sign}`;
  const row = gauge.beam === "H" ? -4.6 - Math.max(3.2, 11.5 / view.k) * (rows[key] = (rows[key] ?? -1) + 1) : Math.max((y0 + y1) / 2, -13);
  // The leader of a gauge far out meets the outer end of its label, any other the inner end.
  const outer = gauge.beam === "H" && Math.abs(middle[0]) > 8;
  const at = sign * (outer ? 18 : 3.4);
  const text = `SG${n + 1} ${value === null ? "\u2013" : signed(value, 0)}`;
  context.strokeStyle = colour.edge;
  context.lineWidth = 0.8;
  segment(context, view.x(middle[0]), view.y(middle[1]), view.x(at - (outer ? -1 : 1) * sign * 0.3), view.y(row) - (outer ? 5 : 0));
  context.textAlign = sign < 0 !== outer ? "right" : "left";
  context.fillStyle = value === null || stale ? colour.soft : colour.ink;
  context.fillText(text, view.x(at), view.y(row));
}

function force(view, { r }, state, scale) {
  const { context } = view;
  const phi = state.phi * RADIANS;
  const pushes = state.theta === null || Math.cos(phi - state.theta * RADIANS) < 0;
  // Without a contact angle only the line of action is drawn, through the middle of the tip.
  const at = state.theta === null ? [0, r * 0.5] : [r * Math.cos(state.theta * RADIANS), r * Math.sin(state.theta * RADIANS)];
  const out = pushes ? -1 : 1; // from the contact outwards, along phi or against it
  const U = state.uPhi === null ? null : K * state.uPhi * RADIANS;
  const along = [out * Math.cos(phi), out * Math.sin(phi)];
  const [start, length] = inside(view, at, along, FULL * Math.min(state.P / scale.newtons, 1));
  if (state.theta !== null && state.uTheta !== null) arc(view, r, state.theta, K * state.uTheta);
  if (U !== null) cone(view, start, phi, out, Math.min(U, Math.PI), length, (FULL * K * (state.uP ?? 0)) / scale.newtons);
  const end = [start[0] + length * along[0], start[1] + length * along[1]];
  const [tail, head] = pushes ? [end, start] : [start, end];
  if (state.theta !== null) arrow(view, tail, head);
  else line(view, tail, head);
  if (state.P > scale.newtons) broken(view, tail, head);
  if (state.theta === null) return;
  context.fillStyle = colour.force;
  context.strokeStyle = colour.card;
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(view.x(at[0]), view.y(at[1]), Math.max(3, 0.9 * view.k), 0, 2 * Math.PI);
  context.fill();
  context.stroke();
}

// An arrow that would pass an edge of the drawing is moved inwards along its line of action, with its whole length.
function inside(view, at, along, length) {
  const low = [EDGE - view.half, view.low + EDGE], high = [view.half - EDGE, view.high - EDGE];
  const room = (sign) => Math.min(...[0, 1].map((n) => {
    const step = sign * along[n];
    return Math.abs(step) < 1e-9 ? Infinity : ((step > 0 ? high[n] : low[n]) - at[n]) / step;
  }));
  const back = Math.min(Math.max(length - room(1), 0), room(-1));
  return [[at[0] - back * along[0], at[1] - back * along[1]], Math.min(length, room(1) + back)];
}

function arc(view, r, theta, U) {
  const { context } = view;
  const half = Math.min(U, 180) * RADIANS, middle = theta * RADIANS;
  context.strokeStyle = colour.cone;
  context.lineWidth = Math.max(2.5, 0.7 * view.k);
  context.beginPath();
  context.arc(view.x(0), view.y(0), r * view.k, -(middle + half), -(middle - half));
  context.stroke();
}

function cone(view, at, phi, out, half, length, spread) {
  const { context } = view;
  const direction = -(out > 0 ? phi : phi + Math.PI); // the canvas rotates in the opposite sense
  const radius = (length + spread) * view.k;
  context.beginPath();
  context.moveTo(view.x(at[0]), view.y(at[1]));
  context.arc(view.x(at[0]), view.y(at[1]), radius, direction - half, direction + half);
  context.closePath();
  const before = context.globalAlpha;
  context.fillStyle = colour.cone;
  context.globalAlpha = before * 0.28;
  context.fill();
  context.globalAlpha = before * 0.85;
  context.strokeStyle = colour.cone;
  context.lineWidth = 1;
  context.stroke();
  context.globalAlpha = before;
}

function line(view, tail, head) {
  const { context } = view;
  context.strokeStyle = colour.force;
  context.lineWidth = Math.max(3, view.k);
  context.setLineDash([8, 6]);
  segment(context, view.x(tail[0]), view.y(tail[1]), view.x(head[0]), view.y(head[1]));
  context.setLineDash([]);
}

// Two bars across the shaft: the force is beyond the scale, and the arrow too short.
function broken(view, tail, head) {
  const { context } = view;
  const [tx, ty, hx, hy] = [view.x(tail[0]), view.y(tail[1]), view.x(head[0]), view.y(head[1])];
  const length = Math.hypot(hx - tx, hy - ty), ux = (hx - tx) / length, uy = (hy - ty) / length;
  context.strokeStyle = colour.bad;
  context.lineWidth = 3;
  const bar = 1.2 * SHAFT * view.k;
  context.beginPath();
  for (const at of [0.35, 0.45]) {
    const [x, y] = [tx + at * (hx - tx), ty + at * (hy - ty)];
    context.moveTo(x - bar * uy, y + bar * ux);
    context.lineTo(x + bar * uy, y - bar * ux);
  }
  context.stroke();
}

function arrow(view, tail, head) {
  const { context } = view;
  const [tx, ty, hx, hy] = [view.x(tail[0]), view.y(tail[1]), view.x(head[0]), view.y(head[1])];
  const length = Math.hypot(hx - tx, hy - ty);
  if (length < 1) return;
  const ux = (hx - tx) / length, uy = (hy - ty) / length;
  const size = Math.min(HEAD * view.k, 0.6 * length), wing = 0.5 * size; // seen from across a room
  context.strokeStyle = context.fillStyle = colour.force;
  context.lineWidth = Math.min(SHAFT * view.k, 0.25 * length);
  segment(context, tx, ty, hx - ux * size * 0.8, hy - uy * size * 0.8);
  context.beginPath();
  context.moveTo(hx, hy);
  context.lineTo(hx - ux * size - uy * wing, hy - uy * size + ux * wing);
  context.lineTo(hx - ux * size + uy * wing, hy - uy * size - ux * wing);
  context.closePath();
  context.fill();
}

// The bar of strain colours.
export function drawLegend(context, scale, width, height) {
  context.font = `11px ${font.family}`;
  context.textBaseline = "middle";
  const middle = height / 2, left = 46, bar = 120;
  for (let n = 0; n < bar; n += 1) {
    context.fillStyle = strainColour(((2 * n) / (bar - 1) - 1) * scale.fullStrain, scale.fullStrain);
    context.fillRect(left + n, middle - 5, 1.5, 10);
  }
  context.strokeStyle = colour.card;
  context.lineWidth = 0.9;
  context.save();
  context.beginPath();
  context.rect(left, middle - 5, bar / 2, 10);
  context.clip();
  context.beginPath();
  for (let s = left - 10; s < left + bar / 2; s += 5) {
    context.moveTo(s, middle + 5);
    context.lineTo(s + 10, middle - 5);
  }
  context.stroke();
  context.restore();
  context.fillStyle = colour.soft;
  context.textAlign = "right";
  context.fillText(signed(-scale.fullStrain, 0), left - 5, middle);
  context.textAlign = "left";
  context.fillText(`${signed(scale.fullStrain, 0)} microstrain`, left + bar + 6, middle);
}
