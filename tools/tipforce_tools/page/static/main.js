// The page: data from the server, the view of it, and the moment shown.
import { drawAngles } from "./angles.js";
import { Card, sizeCanvas } from "./cards.js";
import { isBad } from "./charts.js";
import { Link, fetchCsv, save } from "./link.js";
import { savePicture } from "./picture.js";
import { clock, duration, nice, number } from "./format.js";
import { Panel } from "./panel.js";
import { drawLegend } from "./section.js";
import { CURVES, startTheme } from "./theme.js";

const LATE_MS = 500; // an older message, or a longer silence of the server, is not "live"
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const $ = (id) => document.getElementById(id);

const page = {
  setup: null, cards: [], chosen: 0,
  mode: "wait", // live, paused, replay, wait
  message: null, // the last one of the server
  states: [], events: [], speed: 1,
  lateBy: Infinity, arrived: 0, link: null, stream: 0, lost: false,
  scale: null, // full scales {newtons, microstrain}: fixed unless the user changes them
  dirty: false, drawnAt: 0, asked: 0,
};
const inSight = new Set();
const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) inSight[isIntersecting ? "add" : "delete"](target);
  page.dirty = true;
});
const panel = new Panel(page, {
  ask: (request) => page.link.ask(request),
  moveTo: (t) => scrubTo(Math.min(Math.max(t, page.message.start), page.message.end)),
  changed: (span) => { page.dirty = true; if (span) respan(); },
  built: (canvases) => { canvases.forEach((canvas) => sight.observe(canvas)); page.dirty = true; },
  pause: () => pause(),
  isOther, failed,
});
// For measurements and tests: messages received and pictures drawn so far, and the charts.
window.tipforce = { messages: 0, drawn: 0, panel };

// --- start -----------------------------------------------------------------------------------------------------

// `moment`: that of a paused page, which keeps its picture unless the server has other fingers.
async function begin(moment = null) {
  const setup = await page.link.ask({ do: "setup" }), { start, end } = setup.picture;
  if (moment !== null && setup.generation === page.setup.generation) return;
  page.setup = setup;
  $("title").textContent = setup.title;
  document.title = `tipforce: ${setup.title}`;
  page.events = setup.live ? setup.events : []; // those of a recording come with its moments
  page.cards = setup.fingers.map((geometry, n) => new Card(geometry, () => choose(n), setup.no_tare ? null : () => tare(geometry)));
  page.cards.forEach(({ element }, n) => element.style.setProperty("--own", `var(--curve${(n % CURVES) + 1})`));
  sight.disconnect();
  page.scale ??= setup.scale;
  offerScales();
  page.cards.forEach((card) => sight.observe(card.canvas));
  $("fingers").replaceChildren(...page.cards.map((card) => card.element));
  choose(Math.min(page.chosen, Math.max(0, page.cards.length - 1)));
  const missing = setup.fingers.some((finger) => !finger.gauges.length) ? "Gauge positions are not known: see --layout. " : "";
  const spread = setup.fingers.every((finger) => finger.calibrated_here) ? "" : "Uncertainty: only with a calibration or a health PDO. ";
  $("note").textContent = missing + spread;
  $("band").hidden = false;
  $("python").textContent = setup.python;
  $("python").parentElement.hidden = !setup.python;
  showEvents();
  take(setup.picture);
  panel.begin(setup);
  if (moment !== null && end) goTo(Math.min(Math.max(moment, start), end));
  else if (setup.live) goLive();
  else if (calm.matches) goTo(setup.rest ?? start);
  else play();
}

// --- time ------------------------------------------------------------------------------------------------------

function listen(parameters) {
  page.arrived = performance.now();
  page.lateBy = Infinity;
  const after = page.events.length ? page.events[page.events.length - 1].n : 0;
  page.stream = page.link.send({ do: "stream", bin: panel.binMs, what: panel.what, after, ...parameters });
}

function connected() {
  begin(page.setup && page.mode !== "live" ? page.message.t : null).catch(failed);
}

// Whether a message is about other fingers than those of the cards; the page then starts again.
function isOther({ generation }) {
  if (generation === page.setup.generation) return false;
  page.stream = 0;
  begin(page.mode === "paused" ? page.message.t : null).catch(failed);
  return true;
}

function disconnected() {
  page.stream = 0;
  if (page.mode === "replay") pause();
}

async function goLive() {
  setMode("live");
  panel.follow(page.message.end, true);
  listen({});
  await panel.fill();
}

async function play() {
  if (page.setup.live && page.mode === "live") return;
  const from = atEnd() ? page.message.start : page.message.t;
  setMode("replay");
  panel.follow(from, false);
  listen({ start: from, speed: page.speed });
  await panel.fill();
}

// The span of the charts has changed, or what they show.
async function respan() {
  if (page.mode === "live") await goLive();
  else if (page.mode === "replay") await play();
  else await panel.fill();
}

// Play begins again from the first moment of a recording.
function atEnd() {
  return !page.setup.live && page.message.t >= page.message.end - 1;
}

function pause() {
  setMode("paused");
  if (page.stream) page.link.send({ do: "pause" });
  page.stream = 0;
}

async function goTo(t) {
  if (page.mode !== "paused") pause();
  const turn = (page.asked += 1);
  const message = await page.link.ask({ do: "at", t }).catch(failed);
  if (!message || turn !== page.asked || page.mode !== "paused" || isOther(message)) return;
  take(message);
  if (panel.follow(message.t, false) || !panel.bins.rows.size) await panel.fill();
}

let next = null, busy = false;
async function scrubTo(t) { // one request at a time: fast dragging must not fill the server's queue
  next = t;
  if (busy) return;
  busy = true;
  while (next !== null) {
    const wanted = next;
    next = null;
    await goTo(wanted);
  }
  busy = false;
}

function setMode(mode) {
  page.mode = mode;
  page.dirty = true;
  $("live").hidden = !page.setup.live || mode === "live";
  $("speed").parentElement.hidden = mode === "live"; // the speed of a replay
  showMode();
}

function showMode() {
  const shown = page.lost && page.mode === "live" ? "lost" : page.mode;
  const ended = page.mode === "paused" && atEnd(), paused = ended ? "ended" : "paused";
  const text = { live: "live", paused, replay: `replay ${page.speed} \u00d7`, wait: "connecting", lost: "not live" }[shown];
  const button = page.mode !== "paused" ? "Pause" : ended ? "Play again" : "Play";
  $("mode").dataset.mode = shown;
  if ($("play").textContent !== button) $("play").textContent = button;
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
  if (isOther(message)) return;
  panel.bins.add(message.bins);
  const live = page.mode === "live";
  if (message.events) {
    page.events = [...page.events, ...message.events].slice(-500);
    showEvents();
    speak(message.events);
  }
  take(message);
  if (panel.follow(message.t, live)) panel.fill();
  panel.bins.prune(panel.from - 0.1 * panel.widthMs);
  if (message.ended) end();
}

// The end of a recording: again from the beginning, or still, on its best moment if it has one.
function end() {
  const { loops, rest } = page.setup;
  if (!loops) pause();
  if (rest !== null && !loops) goTo(rest);
  if (!loops) return;
  page.events = [];
  showEvents();
  play();
}

function take(message) {
  if (message.events && !message.bins) {
    page.events = message.events;
    showEvents();
  }
  page.message = message;
  page.states = message.fingers.map(stateOf);
  panel.offer(page.states);
  page.dirty = true;
  showMode();
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
  page.dirty = false;
  const states = shownStates(), { message } = page;
  const scale = drawingScale();
  page.cards.forEach((card, n) => {
    const state = states[n];
    if (!state) return;
    card.show(state, message.t, page.mode === "live", page.mode === "live" && message.nmt ? message.nmt[n] ?? "" : nmtOf(card.geometry.node_id, message.t));
    if (everything || inSight.has(card.canvas)) card.draw(state, scale);
  });
  const [context, width, height] = sizeCanvas($("legend"));
  drawLegend(context, scale, width, height);
  drawAngles(...sizeCanvas($("angles")));
  panel.draw((canvas) => everything || inSight.has(canvas));
  showBus(message);
  $("frames").hidden = !message.frames;
  $("frames").textContent = (message.frames ?? []).join("\n");
  showTime(message);
  window.tipforce.drawn += 1;
}

// The lists of full scales; the present one is always among them.
function offerScales() {
  for (const [name, unit] of [["newtons", "N"], ["microstrain", "microstrain"]]) {
    const steps = name === "newtons" ? [0.5, 1, 2, 5, 10, 20, 50] : [50, 100, 200, 500, 1000, 2000, 5000];
    const values = [...new Set([...steps, page.scale[name]])].sort((a, b) => a - b);
    $(name).replaceChildren(...values.map((value) => new Option(`${value} ${unit}`, String(value))), new Option("fit", "fit"));
    $(name).value = String(page.scale[name]);
  }
}

// "fit" takes the smallest step that holds the present values.
function setScale(name, text) {
  const values = name === "newtons" ? page.states.map((s) => s.P ?? 0) : page.states.flatMap((s) => (s.gauges ?? []).map((g) => Math.abs(g ?? 0)));
  page.scale[name] = text === "fit" ? nice(Math.max(name === "newtons" ? 0.5 : 50, ...values)) : Number(text);
  offerScales();
  page.dirty = true;
}

function drawingScale() {
  return { fullStrain: page.scale.microstrain, newtons: page.scale.newtons };
}

// What rows can lack, in words, and how often they did.
const LACKS = {
  "finger without a PDO": (c) => c.missing,
  "PDO came too late": (c) => c.late,
  "PDOs of two SYNCs": (c) => c.mixed,
  "settings may have changed": (c) => c.doubtful,
  "frames lost by this machine": (c) => [c.dropped, c.overrun],
};

function showBus({ rate, period, counters, error }) {
  const sum = (list) => list.reduce((total, value) => total + value, 0);
  const load = `${number(100 * counters.load[0], 1)} to ${number(100 * counters.load[1], 1)} %`;
  const lacks = Object.entries(LACKS).map(([name, of]) => [name, sum(of(counters))]).filter(([, count]) => count);
  const entries = [
    ["rate", rate ? `${number(rate, rate < 100 ? 1 : 0)} Hz` : "no SYNC", !rate],
    ...(period ? [["period", `${number(period, 3)} ms`]] : []),
    ...(counters.load[0] === null ? [] : [["bus load", load, counters.load[1] > 0.8]]),
    ["rows", lacks.length || !counters.rows ? String(counters.rows) : `${counters.rows}, all complete`],
    ...lacks.map(([name, count]) => [name, String(count), true]),
  ];
  if (counters.jitter_p99_us !== null) entries.push(["SYNC jitter p99", `${number(counters.jitter_p99_us, 0)} \u00b5s`]);
  const list = $("bus");
  if (list.children.length !== entries.length || entries.some(([name], n) => list.children[n].firstChild.textContent !== name)) {
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
  const step = Math.max(10, (end - start) / 500);
  scrub.min = start;
  scrub.max = start + Math.max(1, Math.ceil((end - start) / step)) * step;
  scrub.step = step;
  if (page.mode === "live" || t >= end) scrub.value = scrub.max;
  else if (document.activeElement !== scrub || page.mode === "replay") scrub.value = t;
  const behind = page.setup.live && page.mode !== "live" ? `  \u2212${duration(Math.max(0, end - t))}` : "";
  const text = clock(t, 2) + behind;
  $("when").textContent = text;
  scrub.setAttribute("aria-valuetext", text);
}

function nmtOf(node, until) {
  for (let n = page.events.length - 1; n >= 0; n -= 1) {
    const event = page.events[n];
    if (event.node !== node || event.t > until) continue;
    if (event.kind === "state") return event.text;
    if (event.kind === "duplicate") return "id is that of two nodes";
    if (event.kind === "boot_up") return "booted";
    if (event.kind === "heartbeat_lost") return "heartbeat lost";
    if (event.kind === "heartbeat_back") return event.text.replace("heartbeat received, ", "");
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
    text.append(who, ` ${event.kind.replaceAll("_", " ")}${event.text ? `: ${event.text}` : ""}`);
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
  panel.label();
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
  for (const name of ["newtons", "microstrain"]) $(name).addEventListener("change", () => setScale(name, $(name).value));
  $("scrub").addEventListener("input", () => scrubTo(Math.min(Number($("scrub").value), page.message.end)));
  $("png").addEventListener("click", () => savePicture(page, shownStates(), panel, drawingScale()));
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
