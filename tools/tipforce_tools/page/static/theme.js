// Colours come from the style sheet, so that drawings follow light, dark and print.
const NAMES = ["paper", "card", "ink", "soft", "line", "faint", "body", "edge", "beam", "neutral", "minus", "plus",
  "force", "cone", "select", "good", "warn", "bad", "curve1", "curve2", "curve3", "curve4", "curve5"];
const dark = matchMedia("(prefers-color-scheme: dark)");
let printing = false;
export const colour = {};
export const font = { family: "sans-serif" };

// Each finger has its colour, in the charts and on its card; from the sixth on the line is dashed.
export const CURVES = 5;
export const fingerColour = (n) => colour[`curve${(n % CURVES) + 1}`];

function read() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) colour[name] = style.getPropertyValue(`--${name}`).trim();
  font.family = style.getPropertyValue("--font").trim();
}

export function startTheme(select, changed) {
  const root = document.documentElement;
  const apply = () => {
    const wanted = root.dataset.theme;
    root.dataset.shown = printing ? "light" : wanted === "auto" ? (dark.matches ? "dark" : "light") : wanted;
    read();
    changed();
  };
  root.dataset.theme = ["light", "dark"].find((name) => name === localStorage.getItem("theme")) ?? "auto";
  select.value = root.dataset.theme;
  select.addEventListener("change", () => {
    root.dataset.theme = select.value;
    localStorage.setItem("theme", select.value);
    apply();
  });
  dark.addEventListener("change", apply);
  addEventListener("beforeprint", () => { printing = true; apply(); });
  addEventListener("afterprint", () => { printing = false; apply(); });
  apply();
}

const rgb = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16));

// Strain on a diverging scale: minus is compression, plus is tension.
export function strainColour(microstrain, full) {
  if (!Number.isFinite(microstrain)) return colour.neutral;
  const share = Math.min(1, Math.abs(microstrain) / full) ** 0.8;
  const from = rgb(colour.neutral), to = rgb(microstrain < 0 ? colour.minus : colour.plus);
  return `rgb(${from.map((c, k) => Math.round(c + (to[k] - c) * share)).join(" ")})`;
}
