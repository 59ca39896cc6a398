// Figures and times as people read them.

export const percent = (value, digits = 1) => `${(100 * value).toFixed(digits)} %`;
export const short = (value) => percent(value, value < 0.01 ? 1 : 0); // of a kind of ground
export const figure = (value) => value.toFixed(value < 9.95 ? 2 : value < 99.5 ? 1 : 0);
export const spread = (std) => (std === null || std === undefined ? "" : ` ± ${(100 * std).toFixed(1)}`);
export const metres = (value) => (value >= 1000 ? `${(value / 1000).toFixed(2)} km` : `${Math.round(value)} m`);

const SPANS = [[90, 1, "s"], [5400, 60, "min"], [172800, 3600, "h"], [Infinity, 86400, "d"]];
export function span(s) {
  const [, unit_s, unit] = SPANS.find(([below_s]) => s < below_s);
  return `${Math.round(s / unit_s)} ${unit}`;
}
export const ago = (s) => (s < 5 ? "just now" : `${span(s)} ago`);

const date = (ns, options) => new Date(ns / 1e6).toLocaleDateString("en-GB", { ...options, timeZone: "UTC" });
export const clock = (ns, seconds = false) => new Date(ns / 1e6).toISOString().slice(11, seconds ? 19 : 16);
export const dayShort = (ns) => date(ns, { day: "numeric", month: "short" });
export const day = (ns) => date(ns, { day: "numeric", month: "short", year: "numeric" });

export function duration(seconds) {
  const whole = Math.round(seconds), minutes = Math.floor(whole / 60), two = (n) => String(n % 60).padStart(2, "0");
  return minutes < 60 ? `${minutes}:${two(whole)}` : `${Math.floor(minutes / 60)}:${two(minutes)}:${two(whole)}`;
}
