// The charts: what they show, over which span of time, zoom, and the values under the pointer.
import { Bins } from "./bins.js";
import { LEFT, RIGHT, drawChart } from "./charts.js";
import { sizeCanvas } from "./cards.js";
import { QUANTITIES, spanText } from "./format.js";
import { CURVES, colour, fingerColour } from "./theme.js";

const BINS = 500; // in a chart's width
const LEAST_MS = 20, MOST_MS = 1000 * 3600 * 24 * 366;
const WINDOWS_S = [1, 2, 5, 10, 30, 120, 300, 1800, 7200];
const LIVE_S = [5, 10, 30, 120, 300];
const DRAG = 6; // pixels: less is a click
const $ = (id) => document.getElementById(id);

export class Panel {
  // actions: {ask, moveTo(t), changed(spanToo), isOther(message), failed}; page: the state of main.js
  constructor(page, actions) {
    Object.assign(this, { page, actions, what: "contact", widthMs: 10000, from: 0, to: 1, pointer: null, drag: null });
    this.bins = new Bins(20, 3);
    this.canvases = [];
    $("what").addEventListener("change", () => this.chart($("what").value));
    $("window").addEventListener("change", () => this.setWidth(Number($("window").value)));
    $("closer").addEventListener("click", () => this.zoom(0.5));
    $("wider").addEventListener("click", () => this.zoom(2));
    $("whole").addEventListener("click", () => this.setWidth(0));
    this.build();
  }

  // Whole microseconds: number x width must be exact for times since 1970.
  get binMs() { return Math.max(0.5, Math.ceil((1000 * this.widthMs) / BINS) / 1000); }

  // --- what ----------------------------------------------------------------------------------------------------

  // The source: a recording is shown as a whole.
  begin(setup) {
    const { start, end } = setup.picture, span = end - start;
    this.quantities = { contact: 3, forces: 3, gauges: setup.gauges };
    const offered = setup.live ? LIVE_S : WINDOWS_S.filter((seconds) => 1000 * seconds < span);
    $("window").replaceChildren(...(setup.live ? [] : [new Option("whole recording", "0")]),
      ...offered.map((seconds) => new Option(spanText(seconds), String(seconds))));
    $("whole").hidden = setup.live;
    if (setup.live) this.widthMs = Math.min(Math.max(this.widthMs, 5000), 300000);
    else this.span(start, span);
    if (!this.options().some((one) => one.value === this.what)) this.what = "contact";
    this.build();
    this.showWidth();
  }

  options() { return [...$("what").options].filter((one) => !one.hidden); }

  // Gauges are offered once one has a value.
  offer(states) {
    const option = $("what").querySelector("[value=gauges]");
    if (option.hidden && states.some(({ gauges }) => gauges?.some((value) => value !== null))) option.hidden = false;
  }

  chart(what) {
    this.what = what;
    $("what").value = what;
    this.build();
    this.actions.changed(true);
  }

  build() {
    const count = this.what === "contact" ? 3 : 1;
    this.canvases = Array.from({ length: count }, (_, n) => {
      const canvas = document.createElement("canvas");
      canvas.className = `chart${n === count - 1 ? " last" : ""}${count === 1 ? " tall" : ""}`;
      canvas.setAttribute("role", "img");
      this.listen(canvas);
      return canvas;
    });
    $("plots").replaceChildren(...this.canvases);
    this.label();
    this.actions.built(this.canvases);
  }

  label() {
    const { setup, chosen } = this.page, label = setup?.fingers[chosen]?.label ?? "";
    const subject = { contact: "Contact", forces: "Forces", gauges: "Gauges" }[this.what];
    $("charted").textContent = `${subject} over time: ${label}`;
    this.canvases.forEach((canvas, n) => {
      const { symbol, name, unit } = QUANTITIES[n];
      const text = this.what === "contact" ? `${name} ${symbol} of ${label} over time, ${unit}`
        : this.what === "forces" ? `forces F1, F2, F3 of ${label} over time, N` : `gauges of ${label} over time, microstrain`;
      canvas.setAttribute("aria-label", text);
    });
  }

  // --- span ----------------------------------------------------------------------------------------------------

  span(from, widthMs) {
    this.from = from;
    this.widthMs = Math.min(Math.max(widthMs, LEAST_MS), MOST_MS);
    this.to = from + this.widthMs;
  }

  // A live page ends at the present; in a recording the span stays while the moment is in it.
  follow(t, live) {
    if (live) {
      this.from = t - this.widthMs;
      this.to = t;
    } else if (t < this.from || t > this.to) {
      // After the end, the moment is on the left: what follows is visible.
      const from = t - (t < this.from ? 0.5 : 0.02) * this.widthMs, { start } = this.page.message;
      this.span(Math.max(from, start - 0.02 * this.widthMs), this.widthMs);
      return true;
    }
    return false;
  }

  setWidth(seconds) {
    const { message } = this.page, whole = !seconds, width = whole ? message.end - message.start : 1000 * seconds;
    const from = whole ? message.start : Math.min(Math.max(message.t - width / 2, message.start), Math.max(message.end - width, message.start));
    this.span(from, width);
    this.showWidth();
    this.actions.changed(true);
  }

  zoom(factor, about = this.page.mode === "live" ? this.to : this.page.message.t) {
    const share = (about - this.from) / this.widthMs, width = Math.min(Math.max(this.widthMs * factor, LEAST_MS), MOST_MS);
    this.span(about - share * width, width);
    this.showWidth();
    this.actions.changed(true);
  }

  // The list shows a width that it does not offer as a further entry.
  showWidth() {
    const select = $("window"), { message, setup } = this.page;
    select.querySelector("[data-other]")?.remove();
    const whole = !setup?.live && message && Math.abs(this.widthMs - (message.end - message.start)) < 1;
    const value = whole ? "0" : String(this.widthMs / 1000);
    if (![...select.options].some((one) => one.value === value)) {
      const other = new Option(spanText(this.widthMs / 1000), value);
      other.dataset.other = "";
      select.append(other);
    }
    select.value = value;
  }

  async fill() {
    const bins = new Bins(this.binMs, this.quantities[this.what]), { from, to, what } = this;
    this.bins = bins;
    const request = { do: "history", start: Math.max(0, from), end: to, bin: bins.widthMs, what };
    const found = await this.actions.ask(request).catch(this.actions.failed);
    if (!found || this.bins !== bins || this.actions.isOther(found)) return;
    found.i.forEach((index, n) => { if (!bins.rows.has(index)) bins.set(index, found.v[n]); });
    this.actions.changed(false);
  }

  // --- pointer -------------------------------------------------------------------------------------------------

  timeAt(canvas, event) {
    const share = (event.offsetX - LEFT) / (canvas.clientWidth - LEFT - RIGHT);
    return this.from + Math.min(1, Math.max(0, share)) * (this.to - this.from);
  }

  listen(canvas) {
    canvas.addEventListener("pointermove", (event) => {
      this.pointer = this.timeAt(canvas, event);
      if (this.drag && event.pointerType === "touch") this.actions.moveTo(this.pointer);
      this.actions.changed(false);
    });
    canvas.addEventListener("pointerdown", (event) => {
      this.drag = { x: event.offsetX, t: this.timeAt(canvas, event) };
      this.pointer = this.drag.t;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointerup", (event) => {
      const { drag } = this, t = this.timeAt(canvas, event);
      this.drag = null;
      if (!drag) return;
      if (event.pointerType === "touch" || Math.abs(event.offsetX - drag.x) < DRAG) this.actions.moveTo(t);
      else this.select(Math.min(drag.t, t), Math.max(drag.t, t));
    });
    const leave = () => { this.pointer = this.drag = null; this.actions.changed(false); };
    canvas.addEventListener("pointerleave", leave);
    canvas.addEventListener("pointercancel", leave);
    canvas.addEventListener("dblclick", () => { if (!this.page.setup.live) this.setWidth(0); });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return; // the plain wheel scrolls the page
      event.preventDefault();
      this.zoom(event.deltaY > 0 ? 1.25 : 0.8, this.timeAt(canvas, event));
    }, { passive: false });
  }

  select(from, to) {
    if (this.page.mode === "live") this.actions.pause();
    this.span(from, to - from);
    this.showWidth();
    this.actions.changed(true);
  }

  // --- drawing -------------------------------------------------------------------------------------------------

  chartOptions(n) {
    const { page, what } = this, { fingers } = page.setup, { newtons, microstrain } = page.scale;
    const selected = this.drag && this.pointer !== null ? [this.drag.t, this.pointer] : null;
    const common = {
      bins: this.bins, from: this.from, to: this.to, periodMs: page.message.period || 0, events: page.events,
      node: fingers[page.chosen]?.node_id, axis: n === this.canvases.length - 1, pointer: this.pointer, selected,
      cursor: page.mode === "live" ? null : page.message.t,
    };
    if (what === "contact") {
      const { symbol, unit, least, digits } = QUANTITIES[n];
      const curves = fingers.map(({ label }, finger) => ({
        name: label, finger, quantity: n, main: finger === page.chosen, colour: fingerColour(finger), dashed: finger >= CURVES,
      }));
      curves.push(...curves.splice(page.chosen, 1)); // the selected one on top
      const title = `${symbol} in ${unit === "\u00b0" ? "degrees" : unit}`;
      return { ...common, curves, title, digits, least, degrees: n > 0, range: n ? null : [0, newtons] };
    }
    const names = what === "forces" ? ["F1", "F2", "F3"] : Array.from({ length: this.quantities.gauges }, (_, k) => `SG${k + 1}`);
    const curves = names.map((name, quantity) => ({
      name, finger: page.chosen, quantity, main: true, colour: colour[`curve${(quantity % 4) + 1}`],
    }));
    const full = what === "forces" ? newtons : microstrain;
    const title = what === "forces" ? "F1 = P sin \u03c6, F2 = P sin(\u03c6 \u2212 \u03b8), F3 = P cos \u03c6, in N" : "strain in microstrain";
    return { ...common, curves, title, digits: what === "forces" ? 3 : 1, range: [-full, full] };
  }

  draw(visible) {
    this.canvases.forEach((canvas, n) => {
      if (!visible(canvas)) return;
      const [context, width, height] = sizeCanvas(canvas);
      drawChart(context, this.chartOptions(n), 0, 0, width, height);
    });
  }
}
