// The reference drawing: what phi, theta, push and pull are. Sense and axes as in the paper: x to the right, y upwards.
import { segment } from "./charts.js";
import { colour, font } from "./theme.js";

const RADIANS = Math.PI / 180;
const THETA = 55, PHI = 215; // degrees, of the example: a push

export function drawAngles(context, width, height) {
  const r = Math.min(width * 0.2, height * 0.42), cx = width * 0.4, cy = height * 0.82;
  const at = (angle, length) => [cx + length * Math.cos(angle * RADIANS), cy - length * Math.sin(angle * RADIANS)];
  context.font = `12px ${font.family}`;
  context.textBaseline = "middle";
  context.textAlign = "left";
  context.fillStyle = colour.body;
  context.strokeStyle = colour.edge;
  context.lineWidth = 1;
  context.beginPath();
  context.arc(cx, cy, r, -Math.PI, 0);
  context.closePath();
  context.fill();
  context.stroke();
  axis(context, [cx, cy], [cx + r * 1.75, cy], "x");
  axis(context, [cx, cy], [cx, cy - r * 1.55], "y");
  const contact = at(THETA, r);
  stroke(context, [cx, cy], contact, colour.soft, [3, 3]);
  arc(context, cx, cy, r * 0.45, 0, THETA);
  label(context, "\u03b8", at(THETA / 2, r * 0.6), colour.ink);
  const phi = PHI - 360, ux = Math.cos(PHI * RADIANS), uy = -Math.sin(PHI * RADIANS), length = r * 1.05;
  const tail = [contact[0] - ux * length, contact[1] - uy * length];
  stroke(context, contact, [contact[0] + r * 0.8, contact[1]], colour.soft, [3, 3]);
  stroke(context, contact, [contact[0] + ux * r * 0.55, contact[1] + uy * r * 0.55], colour.soft, [3, 3]);
  arrow(context, tail, contact);
  arc(context, contact[0], contact[1], r * 0.36, phi, 0);
  label(context, `\u03c6 = ${String(phi).replace("-", "\u2212")}\u00b0`, [contact[0] + r * 0.42, contact[1] + r * 0.3], colour.ink);
  label(context, "P", [tail[0] + 6, tail[1] - 4], colour.force);
}

function stroke(context, from, to, style, dash = [], width = 1) {
  context.setLineDash(dash);
  context.strokeStyle = style;
  context.lineWidth = width;
  segment(context, ...from, ...to);
  context.setLineDash([]);
}

function axis(context, from, to, name) {
  stroke(context, from, to, colour.soft);
  label(context, name, name === "x" ? [to[0] + 4, to[1]] : [to[0] + 5, to[1] + 4], colour.soft);
}

function arc(context, x, y, radius, from, to) {
  context.strokeStyle = colour.cone;
  context.lineWidth = 1.6;
  context.beginPath();
  context.arc(x, y, radius, -to * RADIANS, -from * RADIANS);
  context.stroke();
}

function label(context, text, [x, y], style) {
  context.fillStyle = style;
  context.fillText(text, x, y);
}

function arrow(context, [tx, ty], [hx, hy]) {
  const length = Math.hypot(hx - tx, hy - ty), ux = (hx - tx) / length, uy = (hy - ty) / length;
  stroke(context, [tx, ty], [hx - 7 * ux, hy - 7 * uy], colour.force, [], 2.2);
  context.fillStyle = colour.force;
  context.beginPath();
  context.moveTo(hx, hy);
  context.lineTo(hx - 9 * ux - 4 * uy, hy - 9 * uy + 4 * ux);
  context.lineTo(hx - 9 * ux + 4 * uy, hy - 9 * uy - 4 * ux);
  context.closePath();
  context.fill();
}
