// The page: data from the server, the view of it, and the moment shown.
import { Card, sizeCanvas } from "./cards.js";
import { Bins, LEFT, drawChart, isBad } from "./charts.js";
import { Link, fetchCsv, save } from "./link.js";
import { savePicture } from "./picture.js";
import { QUANTITIES, clock, duration, nice, number } from "./format.js";
import { MARGIN, drawLegend } from "./section.js";
import { startTheme } from "./theme.js";

const LATE_MS = 500; // an older message, or a longer silence of the server, is not "live"
const BINS = 500; // in a chart's width
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const $ = (id) => document.getElementById(id);

const page = {
  setup: null, cards: [], chosen: 0,
  mode: "wait", // live, paused, replay, wait
  message: null, // the last one of the server
  states: [], events: [], bins: new Bins(20),
  windowMs: 10000, speed: 1,
  lateBy: Infinity, arrived: 0, link: null, stream: 0, lost: false,
  scale: { mmPerNewton: 2, fullStrain: 200, barNewtons: 2, pixelsPerMm: 4 },
  dirty: false, drawnAt: 0, asked: 0,
};
const inSight = new Set();
const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) inSight[isIntersecting ? "add" : "delete"](target);
  page.dirty = true;
});
// For measurements: messages received and pictures drawn so far.
window.tipforce = { messages: 0, drawn: 0, longest: 0 };

// --- start -----------------------------------------------------------------------------------------------------

async function begin() {
  page.setup = await page.link.ask({ do: "setup" });
  const { setup } = page;
  $("title").textContent = setup.title;
  document.title = `tipforce: ${setup.title}`;
  page.events = setup.events;
  page.cards = setup.fingers.map((geometry, n) => new Card(geometry, setup.no_tare, () => choose(n), () => tare(geometry)));
  sight.disconnect();
  document.querySelectorAll(".chart").forEach((canvas) => sight.observe(canvas));
  page.cards.forEach((card) => sight.observe(card.canvas));
  $("fingers").replaceChildren(...page.cards.map((card) => card.element));
  choose(Math.min(page.chosen, Math.max(0, page.cards.length - 1)));
  const missing = setup.fingers.some((finger) => !finger.gauges.length) ? "Gauge positions are not known: see --layout. " : "";
  const spread = setup.fingers.every((finger) => finger.calibrated_here) ? "" : "Uncertainty: only with a calibration or a health PDO. ";
  $("note").textContent = missing + spread + (setup.no_tare ? `Tare is off: ${setup.no_tare}.` : "");
  $("live").hidden = !setup.live;
  showEvents();
  take(setup.picture);
  if (setup.live) goLive();
  else goTo(Math.min(setup.picture.start + page.windowMs, setup.picture.end));
}

const binMs = () => Math.max(0.5, page.windowMs / BINS);

// --- time ------------------------------------------------------------------------------------------------------

function listen(parameters) {
  page.arrived = performance.now();
  page.lateBy = Infinity;
  const after = page.events.length ? page.events[page.events.length - 1].n : 0;
  page.stream = page.link.send({ do: "stream", bin: binMs(), after, ...parameters });
}

// The server may have changed: a live page starts again, a paused one keeps its picture.
function connected() {
  if (!page.setup || page.mode === "live") begin().catch(failed);
}

function disconnected() {
  page.stream = 0;
  if (page.mode === "replay") pause();
}

async function goLive() {
  setMode("live");
  const until = page.message.t;
  listen({});
  await fillCharts(until);
}

async function play() {
  if (page.setup.live && page.mode === "live") return;
  const atEnd = page.message.t >= page.message.end - 1;
  const from = !page.setup.live && atEnd ? page.message.start : page.message.t;
  setMode("replay");
  listen({ start: from, speed: page.speed });
  await fillCharts(from);
}

function pause() {
  setMode("paused");
  if (page.stream) page.link.send({ do: "pause" });
  page.stream = 0;
}

async function goTo(t) {
  pause();
  const turn = (page.asked += 1);
  const message = await page.link.ask({ do: "at", t }).catch(failed);
  if (!message || turn !== page.asked || page.mode !== "paused") return;
  take(message);
  await fillCharts(message.t);
}

async function fillCharts(until) {
  const bins = new Bins(binMs()), { mode } = page;
  page.bins = bins;
  const found = await page.link.ask({ do: "history", start: until - page.windowMs, end: until, bin: bins.widthMs }).catch(failed);
  if (!found || page.bins !== bins || page.mode !== mode) return;
  found.i.forEach((index, n) => { if (!bins.rows.has(index)) bins.set(index, found.v[n]); });
  page.dirty = true;
}

function setMode(mode) {
  page.mode = mode;
  page.dirty = true;
  $("play").textContent = mode === "paused" ? "Play" : "Pause";
  showMode();
}

function showMode() {
  const shown = page.lost && page.mode === "live" ? "lost" : page.mode;
  const text = { live: "live", paused: "paused", replay: `replay ${page.speed} \u00d7`, wait: "connecting", lost: "not live" }[shown];
  $("mode").dataset.mode = shown;
  if ($("mode").textContent !== text) $("mode").textContent = text;
}

// --- messages of the server ------------------------------------------------------------------------------------

function receive(message) {
  window.tipforce.messages += 1;
  const now = performance.now(), delay = now - message.t;
  // The minimum delay is the usual one; it may drift slowly with the clocks.
  page.lateBy = Math.min(delay, page.lateBy + 0.02);
  page.arrived = now;
  if (page.mode === "live" && delay - page.lateBy > LATE_MS) page.arrived = now - (delay - page.lateBy);
  if (message.generation !== page.setup.generation) {
    page.stream = 0;
    begin().catch(failed);
    return;
  }
  page.bins.add(message.bins);
  page.bins.prune(message.t - page.windowMs * 1.1);
  if (message.events) {
    page.events = [...page.events, ...message.events].slice(-500);
    showEvents();
    speak(message.events);
  }
  take(message);
  if (message.ended) pause();
}

function take(message) {
  if (message.events && !message.bins) {
    page.events = message.events;
    showEvents();
  }
  page.message = message;
  page.states = message.fingers.map(stateOf);
  page.dirty = true;
}

function stateOf(finger) {
  const [P, phi, theta] = finger.c ?? [null, null, null], [uP, uPhi, uTheta] = finger.u ?? [null, null, null];
  return {
    word: finger.w, why: finger.why ?? "", angle: finger.angle ?? "", since: finger.since, status: finger.s, flags: finger.f ?? [],
    P, phi, theta, uP, uPhi, uTheta, gauges: finger.g,
  };
}

// --- showing ---------------------------------------------------------------------------------------------------

function shownStates() {
  if (!(page.lost && page.mode === "live")) return page.states;
  // The server is silent: its last message is old.
  return page.states.map((state) => (state.word === "silent" ? state
    : { ...state, word: "stale", since: state.since || page.message.t }));
}

function draw(time) {
  requestAnimationFrame(draw);
  const wait = calm.matches ? 250 : 0;
  if (!page.dirty || !page.message || !page.setup || time - page.drawnAt < wait) return;
  page.drawnAt = time;
  paint(false);
}

// Hidden parts are not drawn, unless ``everything`` is set (print); their numbers are always written.
function paint(everything) {
  const begun = performance.now();
  page.dirty = false;
  const states = shownStates(), { message } = page;
  setScale(states);
  page.cards.forEach((card, n) => {
    const state = states[n];
    if (!state) return;
    card.show(state, message.t, page.mode === "live", page.mode === "live" && message.nmt ? message.nmt[n] ?? "" : nmtOf(card.geometry.node_id, message.t));
    if (everything || inSight.has(card.canvas)) page.scale.pixelsPerMm = card.draw(state, page.scale);
  });
  const [context, width, height] = sizeCanvas($("legend"));
  drawLegend(context, page.scale, width, height);
  drawCharts(everything);
  showBus(message);
  showTime(message);
  window.tipforce.drawn += 1;
  window.tipforce.longest = Math.max(window.tipforce.longest, performance.now() - begun);
}

// Steps of 1, 2, 5: a scale that follows each value would hide changes.
function setScale(states) {
  const { scale } = page;
  const strain = Math.max(50, ...states.flatMap((s) => (s.gauges ?? []).map((g) => Math.abs(g ?? 0))));
  const P = Math.max(0.5, ...states.map((s) => s.P ?? 0));
  if (strain > scale.fullStrain || strain < 0.15 * scale.fullStrain) scale.fullStrain = nice(strain);
  const longest = P * scale.mmPerNewton;
  if (longest > MARGIN || longest < 0.15 * MARGIN) scale.mmPerNewton = MARGIN / nice(P);
  scale.barNewtons = nice((0.4 * MARGIN) / scale.mmPerNewton);
}

export function chartOptions(quantity) {
  const to = page.message.t;
  return {
    bins: page.bins, fingers: page.setup.fingers, chosen: page.chosen, quantity, from: to - page.windowMs, to,
    periodMs: page.message.period || 0, events: page.events, axis: quantity === 2,
  };
}

function drawCharts(everything) {
  for (const canvas of document.querySelectorAll(".chart")) {
    if (!everything && !inSight.has(canvas)) continue;
    const [context, width, height] = sizeCanvas(canvas);
    drawChart(context, chartOptions(Number(canvas.dataset.quantity)), 0, 0, width, height);
  }
}

function showBus({ rate, period, counters, error }) {
  const sum = (list) => list.reduce((total, value) => total + value, 0);
  const load = counters.load[0] === null ? "not known"
    : `${number(100 * counters.load[0], 1)} to ${number(100 * counters.load[1], 1)} %`;
  const entries = [
    ["rate", rate ? `${number(rate, rate < 100 ? 1 : 0)} Hz` : "no SYNC", !rate],
    ["period", period ? `${number(period, 3)} ms` : "\u2013"],
    ["bus load", load, counters.load[1] > 0.8],
    ["rows", String(counters.rows)],
    ["missing", String(sum(counters.missing)), sum(counters.missing) > 0],
    ["late", String(sum(counters.late)), sum(counters.late) > 0],
    ["mixed", String(sum(counters.mixed)), sum(counters.mixed) > 0],
    ["doubtful", String(sum(counters.doubtful)), sum(counters.doubtful) > 0],
    ["dropped", String(counters.dropped + counters.overrun), counters.dropped + counters.overrun > 0],
  ];
  if (counters.jitter_p99_us !== null) entries.push(["SYNC jitter p99", `${number(counters.jitter_p99_us, 0)} \u00b5s`]);
  const list = $("bus");
  if (list.children.length !== entries.length) {
    list.replaceChildren(...entries.map(([name]) => {
      const row = document.createElement("div"), term = document.createElement("dt"), value = document.createElement("dd");
      term.textContent = name;
      row.append(term, value);
      return row;
    }));
  }
  entries.forEach(([, text, bad], n) => {
    const value = list.children[n].lastChild;
    if (value.textContent !== text) value.textContent = text;
    value.classList.toggle("not", Boolean(bad));
  });
  const alarm = page.lost && page.mode === "live" ? "No message from the server: the values shown are old." : error;
  $("alarm").hidden = !alarm;
  if (alarm && $("alarm").textContent !== alarm) $("alarm").textContent = alarm;
}

function showTime({ t, start, end }) {
  const scrub = $("scrub");
  scrub.min = start;
  scrub.max = Math.max(end, start + 1);
  if (page.mode === "live") scrub.value = scrub.max;
  else if (document.activeElement !== scrub || page.mode === "replay") scrub.value = t;
  const behind = page.setup.live && page.mode !== "live" ? `  \u2212${duration(Math.max(0, end - t))}` : "";
  const text = clock(t, 2) + behind;
  $("when").textContent = text;
  scrub.setAttribute("aria-valuetext", text);
  const step = Math.max(10, Math.round((end - start) / 500));
  scrub.step = step > 10 ? step : 10;
}

function nmtOf(node, until) {
  for (let n = page.events.length - 1; n >= 0; n -= 1) {
    const event = page.events[n];
    if (event.node !== node || event.t > until) continue;
    if (event.kind === "state") return event.text;
    if (event.kind === "boot_up") return "booted";
    if (event.kind === "heartbeat_lost") return "heartbeat lost";
    if (event.kind === "heartbeat_back") return event.text.replace("heard, ", "");
  }
  return "";
}

function showEvents() {
  const label = (node) => (node ? page.setup.fingers.find((f) => f.node_id === node)?.label ?? `node ${node}` : "bus");
  $("events").replaceChildren(...page.events.slice(-100).reverse().map((event) => {
    const item = document.createElement("li"), time = document.createElement("time"), text = document.createElement("span");
    const who = document.createElement("b");
    time.textContent = clock(event.t);
    who.textContent = label(event.node);
    text.append(who, ` ${event.kind.replace("_", " ")}${event.text ? `: ${event.text}` : ""}`);
    if (isBad(event)) item.dataset.bad = "";
    item.append(time, text);
    return item;
  }));
}

function speak(events) {
  const bad = events.filter(isBad);
  if (bad.length) $("spoken").textContent = bad.map((e) => `node ${e.node}: ${e.text}`).join("; ");
}

function choose(n) {
  page.chosen = n;
  page.cards.forEach((card, k) => card.choose(k === n));
  const label = page.setup.fingers[n]?.label ?? "";
  $("charted").textContent = `Contact over time: ${label}`;
  document.querySelectorAll(".chart").forEach((canvas) => {
    const { symbol, name, unit } = QUANTITIES[canvas.dataset.quantity];
    canvas.setAttribute("aria-label", `${name} ${symbol} of ${label} over time, ${unit}`);
  });
  page.dirty = true;
}

// --- actions ---------------------------------------------------------------------------------------------------

async function tare({ node_id, label }) {
  const dialog = $("confirm");
  $("confirm-head").textContent = `Tare ${label}?`;
  $("confirm-text").textContent =
    `Node ${node_id} sets its present force as zero, until its next reset. Unload the fingertip first: a tare under load hides that load.`;
  dialog.returnValue = "no";
  dialog.showModal();
  await new Promise((done) => dialog.addEventListener("close", done, { once: true }));
  if (dialog.returnValue !== "yes") return;
  const said = await page.link.ask({ do: "tare", node_id }).then(({ text }) => text, (error) => error.message);
  $("spoken").textContent = `${label}: ${said}`;
  $("note").textContent = $("spoken").textContent;
}

function wire() {
  startTheme($("theme"), () => { if (page.setup && page.message) paint(true); });
  $("play").addEventListener("click", () => (page.mode === "paused" ? play() : pause()));
  $("live").addEventListener("click", goLive);
  $("speed").addEventListener("change", () => {
    page.speed = Number($("speed").value);
    if (page.mode === "replay") play();
  });
  $("window").addEventListener("change", () => {
    page.windowMs = 1000 * Number($("window").value);
    if (page.mode === "live") goLive();
    else if (page.mode === "replay") play();
    else goTo(page.message.t);
  });
  let next = null, busy = false;
  const scrubTo = async (t) => { // one request at a time: fast dragging must not fill the server's queue
    next = t;
    if (busy) return;
    busy = true;
    while (next !== null) {
      const wanted = next;
      next = null;
      await goTo(wanted);
    }
    busy = false;
  };
  $("scrub").addEventListener("input", () => scrubTo(Number($("scrub").value)));
  document.querySelectorAll(".chart").forEach((canvas) => canvas.addEventListener("click", (event) => {
    const share = (event.offsetX - LEFT) / (canvas.clientWidth - LEFT - 4);
    const t = page.message.t - page.windowMs * (1 - Math.min(1, Math.max(0, share)));
    scrubTo(Math.max(t, page.message.start));
  }));
  $("png").addEventListener("click", () => savePicture(page, shownStates(), chartOptions));
  $("csv").addEventListener("click", () => fetchCsv().then((blob) => save(blob, "tipforce.csv"), failed));
  document.addEventListener("keydown", (event) => {
    if (event.key !== " " || event.target.closest("button, select, input, a, dialog")) return;
    event.preventDefault();
    $("play").click();
  });
  addEventListener("resize", () => { page.dirty = true; });
  setInterval(() => {
    const lost = page.mode === "live" && performance.now() - page.arrived > LATE_MS;
    if (lost !== page.lost) {
      page.lost = lost;
      page.dirty = true;
    }
    showMode();
  }, 100);
}

function failed(error) {
  $("alarm").hidden = false;
  $("alarm").textContent = String(error.message ?? error);
}

wire();
page.link = new Link((id, message) => { if (id === page.stream) receive(message); }, connected, disconnected);
requestAnimationFrame(draw);
