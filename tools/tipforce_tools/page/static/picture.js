// The view as a PNG: drawn again at twice the size.
import { drawChart } from "./charts.js";
import { sense, stateText } from "./cards.js";
import { K, QUANTITIES, clock, number } from "./format.js";
import { save } from "./link.js";
import { drawLegend, drawSection } from "./section.js";
import { colour, font } from "./theme.js";

const WIDTH = 1280, CARD = 248, CARD_HEIGHT = 345, SECTION = 250, CHART = 120, RATIO = 2;

export function paintPicture(page, states, panel, scale) {
  const perRow = Math.max(1, Math.floor((WIDTH - 20) / CARD)), rows = Math.ceil(states.length / perRow);
  const charts = panel.canvases.length, chart = charts > 1 ? CHART : 2 * CHART;
  const height = 84 + rows * CARD_HEIGHT + charts * chart + 40;
  const canvas = document.createElement("canvas");
  canvas.width = WIDTH * RATIO;
  canvas.height = height * RATIO;
  const context = canvas.getContext("2d");
  context.scale(RATIO, RATIO);
  context.fillStyle = colour.card;
  context.fillRect(0, 0, WIDTH, height);
  const write = (text, x, y, style, look = colour.ink, most = WIDTH - 32) => {
    context.font = `${style} ${font.family}`;
    context.fillStyle = look;
    context.textAlign = "left";
    context.textBaseline = "alphabetic";
    context.fillText(text, x, y, most);
  };
  write(`tipforce  ${page.setup.title}`, 16, 28, "600 17px");
  const day = new Date(page.message.t).toISOString().slice(0, 10);
  write(`${document.getElementById("mode").textContent}, ${day} ${clock(page.message.t, 2)} (times are local, the date is UTC)`, 16, 48, "12px", colour.soft);
  context.save();
  context.translate(16, 54);
  drawLegend(context, scale, 430, 26);
  context.restore();
  states.forEach((state, n) => {
    const x = 10 + (n % perRow) * CARD, y = 84 + Math.floor(n / perRow) * CARD_HEIGHT;
    const geometry = page.setup.fingers[n];
    const word = state.word === "live" && page.mode !== "live" ? "recorded" : state.word;
    const words = [stateText(state, word, page.message.t), sense(state), ...state.flags.filter((flag) => flag !== state.why)];
    write(`${geometry.label}  (node ${geometry.node_id})`, x + 8, y + 16, "600 13px", colour.ink, CARD - 16);
    write(words.filter(Boolean).join(", "), x + 8, y + 32, "12px", state.flags.length ? colour.bad : colour.soft, CARD - 16);
    drawSection(context, geometry, state, scale, x + 8, y + 38, CARD - 16, SECTION);
    const values = [state.P, state.phi, state.theta], spreads = [state.uP, state.uPhi, state.uTheta];
    QUANTITIES.forEach(({ symbol, unit, digits }, k) => {
      const spread = spreads[k] === null ? "" : ` \u00b1 ${number(K * spreads[k], digits)}`;
      write(`${symbol} ${values[k] === null ? "unknown" : `${number(values[k], digits)}${spread} ${unit}`}`, x + 8, y + 305 + 15 * k, "12px");
    });
  });
  const top = 84 + rows * CARD_HEIGHT + 20;
  write(`${document.getElementById("charted").textContent}; bands: k = ${K}`, 16, top, "600 13px");
  panel.canvases.forEach((_, k) => drawChart(context, panel.chartOptions(k), 10, top + 8 + k * chart, WIDTH - 20, chart));
  return canvas;
}

export function savePicture(page, states, panel, scale) {
  paintPicture(page, states, panel, scale).toBlob((blob) => save(blob, "tipforce.png"), "image/png");
}
