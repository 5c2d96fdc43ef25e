// One card per finger: its picture and its numbers. The DOM is touched only where something changed.
import { K, QUANTITIES, clock, duration, number } from "./format.js";
import { drawSection } from "./section.js";

const make = (tag, className, text = "") => {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text) element.textContent = text;
  return element;
};

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function sizeCanvas(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 3);
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return [context, width, height];
}

export class Card {
  constructor(geometry, choose, tare) {
    this.geometry = geometry;
    this.element = make("article", "finger");
    this.element.dataset.node = geometry.node_id;
    const head = make("header");
    this.pick = make("button", "pick", geometry.label);
    this.pick.type = "button";
    this.pick.append(make("span", "", `node ${geometry.node_id}`));
    this.pick.title = "show in the charts";
    this.pick.addEventListener("click", choose);
    this.state = make("span", "state");
    head.append(this.pick, this.state);
    this.canvas = make("canvas");
    this.canvas.setAttribute("role", "img");
    const values = make("dl", "values");
    this.cells = QUANTITIES.map(({ symbol, unit, name }) => {
      const term = make("dt", "", symbol), cell = make("dd");
      term.title = name;
      const parts = { n: make("span", "n"), unit: make("span", "unit", unit), u: make("span", "u") };
      cell.append(parts.n, parts.unit, parts.u);
      values.append(term, cell);
      return parts;
    });
    this.words = make("p", "words");
    this.element.append(head, this.canvas, values, this.words);
    if (tare) this.element.append(tareButton(geometry.label, tare)); // a page that cannot tare shows no button
    this.described = 0;
  }

  choose(chosen) {
    this.element.classList.toggle("chosen", chosen);
    this.pick.setAttribute("aria-pressed", String(chosen));
  }

  show(state, now, isLive, nmt) {
    const word = state.word === "live" && !isLive ? "recorded" : state.word;
    if (this.element.dataset.word !== word) this.element.dataset.word = word;
    setText(this.state, stateText(state, word, now));
    this.numbers(state);
    this.wording(state, nmt);
    if (now - this.described > 1000 || now < this.described) {
      this.described = now;
      this.canvas.setAttribute("aria-label", describe(this.geometry, state, word));
    }
  }

  numbers(state) {
    const values = [state.P, state.phi, state.theta], spreads = [state.uP, state.uPhi, state.uTheta];
    QUANTITIES.forEach(({ digits }, n) => {
      const cell = this.cells[n], known = values[n] !== null;
      cell.n.classList.toggle("why", !known);
      setText(cell.n, known ? number(values[n], digits) : whyUnknown(state, n));
      cell.unit.hidden = !known;
      setText(cell.u, known && spreads[n] !== null ? `\u00b1 ${number(K * spreads[n], digits)}` : "");
    });
  }

  wording(state, nmt) {
    const { flags } = state;
    const key = `${sense(state)}|${flags.join()}|${nmt}`;
    if (key === this.worded) return;
    this.worded = key;
    this.words.replaceChildren();
    if (sense(state)) this.words.append(make("b", "", sense(state)), " ");
    if (nmt) this.words.append(`node ${nmt}`, " ");
    flags.forEach((text) => this.words.append(make("span", "flag", text), " "));
  }

  draw(state, scale) {
    const [context, width, height] = sizeCanvas(this.canvas);
    drawSection(context, this.geometry, state, scale, 0, 0, width, height);
  }
}

function tareButton(label, tare) {
  const button = make("button", "tare", "Tare\u2026");
  button.type = "button";
  button.setAttribute("aria-label", `Tare ${label}`);
  button.addEventListener("click", tare);
  return button;
}

export function sense(state) {
  if (state.word === "silent" || state.P === null) return "";
  if (!(state.status & 1)) return "no contact";
  if (state.phi === null || state.theta === null) return "contact";
  return Math.cos(((state.phi - state.theta) * Math.PI) / 180) < 0 ? "push" : "pull";
}

function whyUnknown(state, n) {
  if (state.word === "silent") return "\u2013";
  if (n && state.P !== null) return `unknown: ${state.angle || "not given"}`;
  return n ? "unknown" : `unknown: ${state.why || "not given"}`;
}

export function stateText(state, word, now) {
  if (word === "stale") return `stale since ${clock(state.since)}`;
  if (word === "silent") return state.since ? `no response for ${duration(now - state.since)}` : "no response";
  return word === "unknown" ? `unknown: ${state.why}` : word;
}

function describe(geometry, state, word) {
  const gauges = (state.gauges ?? []).map((value, n) => `SG${n + 1} ${value === null ? "unknown" : number(value, 0)}`);
  if (state.word === "silent") return `${geometry.label}: no response`;
  if (state.P === null) return `${geometry.label}: ${word}, ${state.why}`;
  const angles = state.phi === null ? state.angle
    : `phi ${number(state.phi, 0)} degrees, theta ${state.theta === null ? state.angle : `${number(state.theta, 0)} degrees`}`;
  return `${geometry.label}: ${word}, ${sense(state)} ${number(state.P, 2)} newtons, ${angles}; ${gauges.join(", ")} microstrain`;
}
