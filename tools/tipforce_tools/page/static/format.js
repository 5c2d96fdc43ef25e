// Formatting of numbers and times.
export const K = 2; // coverage factor of every uncertainty shown
export const QUANTITIES = [
  { symbol: "P", name: "force", unit: "N", digits: 3, least: 0.5 },
  { symbol: "\u03c6", name: "direction of the force", unit: "\u00b0", digits: 1, least: 20 },
  { symbol: "\u03b8", name: "contact angle", unit: "\u00b0", digits: 1, least: 20 },
];

export const number = (value, digits) => value.toFixed(digits).replace("-", "\u2212");
export const signed = (value, digits) => (value > 0 ? "+" : "") + number(value, digits);

const two = (value) => String(value).padStart(2, "0");

export function clock(ms, digits = 1) {
  const date = new Date(ms);
  const seconds = (date.getSeconds() + (ms % 1000) / 1000).toFixed(digits).padStart(digits ? digits + 3 : 2, "0");
  // 59.97 s would round to 60.0, which is not a valid time.
  const shown = seconds.startsWith("60") ? `59.${"9".repeat(digits)}` : seconds;
  return `${two(date.getHours())}:${two(date.getMinutes())}:${shown}`;
}

export function duration(ms) {
  const seconds = Math.max(0, ms / 1000);
  return seconds < 100 ? `${number(seconds, 1)} s` : `${Math.floor(seconds / 60)} min ${two(Math.floor(seconds % 60))} s`;
}

// A width of time: 0.25 s, 10 s, 2 min, 1.5 h.
export function spanText(seconds) {
  const [value, unit] = seconds < 60 ? [seconds, "s"] : seconds < 3600 ? [seconds / 60, "min"] : [seconds / 3600, "h"];
  return `${Number(value.toPrecision(3))} ${unit}`;
}

// 1, 2 or 5 times a power of ten, at least `value`.
export function nice(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-9)));
  return [1, 2, 5, 10].map((k) => k * power).find((k) => k >= value * 0.999999);
}
