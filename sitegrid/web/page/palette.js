// Colours of the ground. A palette turns a value into a colour; a layer says which plane of a tile it shows and how.

const channels = (rgb) => [(rgb >> 16) & 255, (rgb >> 8) & 255, rgb & 255];
const linear = (v) => ((v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const gamma = (v) => Math.round(255 * Math.min(1, Math.max(0, v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055)));

// OKLab (B. Ottosson, "A perceptual color space for image processing", 2020): equal steps look equal.
function toLab(rgb) {
  const [r, g, b] = channels(rgb).map(linear);
  const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
  const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
  const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  return [
    0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s,
    1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
    0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s,
  ];
}
function fromLab([L, a, b]) {
  const l = (L + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (L - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (L - 0.0894841775 * a - 1.291485548 * b) ** 3;
  const red = gamma(4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s);
  const green = gamma(-1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s);
  const blue = gamma(-0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s);
  return (red << 16) | (green << 8) | blue;
}
const between = (low, high) => {
  const [a, b] = [toLab(low), toLab(high)];
  return (u) => { const t = Math.min(1, Math.max(0, u)); return fromLab(a.map((v, i) => v + t * (b[i] - v))); };
};

// Dark blue over grey to yellow: lightness grows all along, for every common colour vision.
export const ordered = between(0x243777, 0xfbdd5c);
export const ink = between(0xcbe4e2, 0x005160);
export const diverging = (u) => (u < 0 ? between(0xd9d9d2, 0x2f4b9b)(-u) : between(0xd9d9d2, 0xb3361c)(u));
export const css = (rgb) => `#${rgb.toString(16).padStart(6, "0")}`;

// The ground's kinds: names, typical values and colours; the boundaries come from the map server.
export const KINDS = [
  { name: "dry concrete", value: 0.008, rgb: 0x28a03c },
  { name: "gravel", value: 0.02, rgb: 0xd72828 },
  { name: "dry dirt", value: 0.04, rgb: 0x232323 },
  { name: "wet dirt", value: 0.06, rgb: 0xfad728 },
  { name: "sand", value: 0.25, rgb: 0x1e5fcd },
];
export const kindOf = (value, boundaries) => boundaries.filter((boundary) => value >= boundary).length;

const SHOWN = { low: 0.006, high: 0.3 }; // ends of the ordered palette
export const place = (value) => Math.log(value / SHOWN.low) / Math.log(SHOWN.high / SHOWN.low);
export const percent = (value, digits = 1) => `${(100 * value).toFixed(digits)} %`;
export const figure = (value) => value.toFixed(value < 9.95 ? 2 : value < 99.5 ? 1 : 0);
export const span = (s) => (s < 90 ? `${Math.round(s)} s` : s < 5400 ? `${Math.round(s / 60)} min` : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} d`);
export const ago = (s) => (s < 5 ? "just now" : `${span(s)} ago`);

// ticks: [place along the palette 0..1, text]. colour: value -> rgb. `fades` names the plane that fades a cell.
// change: [what two values differ by, -1..1; the words for -1 and 1].
export const LAYERS = [
  { id: "resistance", name: "Rolling resistance", unit: "% of weight", key: "1", fades: "confidence",
    colour: (v) => ordered(place(v)), at: place, text: (v) => percent(v),
    ticks: [0.008, 0.02, 0.06, 0.25].map((v) => [place(v), percent(v, v < 0.01 ? 1 : 0)]),
    change: [(now, then) => Math.log(now / then) / Math.log(4), "a quarter", "four times"] },
  { id: "grade", name: "Slope", unit: "rise per length", key: "2", fades: "grade_std",
    colour: (v) => ink(v / 0.3), at: (v) => v / 0.3, text: (v) => percent(v), ticks: [[0, "level"], [0.333, "10 %"], [0.667, "20 %"], [1, "30 %"]],
    change: [(now, then) => (now - then) / 0.2, "−20 %", "+20 %"] },
  { id: "visits", name: "Passes", unit: "visits of machines", key: "3", fades: null,
    colour: (v) => ink(Math.log(v) / Math.log(60)), at: (v) => Math.log(v) / Math.log(60), text: (v) => `${Math.round(v)}`, ticks: [[0, "1"], [0.39, "5"], [0.73, "20"], [1, "60"]],
    change: [(now, then) => (now - then) / 20, "20 fewer", "20 more"] },
  { id: "age", name: "Age", unit: "newest sample", key: "4", fades: null,
    colour: (v) => ink(1 - Math.log(1 + v / 10) / Math.log(8641)), at: (v) => Math.log(1 + v / 10) / Math.log(8641), text: ago,
    ticks: [[0, "now"], [0.215, "1 min"], [0.65, "1 h"], [1, "1 d"]],
    change: [(now, then) => Math.sign(now - then) * Math.log(1 + Math.abs(now - then) / 10) / Math.log(361), "1 h fresher", "1 h older"] },
  { id: "confidence", name: "Confidence", unit: "likely right", key: "5", fades: null,
    colour: (v) => ink((v - 0.3) / 0.7), at: (v) => (v - 0.3) / 0.7, text: (v) => percent(v, 0), ticks: [[0, "30 %"], [0.43, "60 %"], [1, "100 %"]],
    change: [(now, then) => (now - then) / 0.5, "−50 %", "+50 %"] },
];
// How a layer differs between two times, as a layer of its own.
export const differenceOf = ({ name, change: [, less, more] }) => ({ id: "difference", name, unit: "then to now", fades: null, colour: diverging, at: (v) => (v + 1) / 2, ticks: [[0, less], [0.5, "same"], [1, more]] });
export const layerOf = (id) => LAYERS.find((layer) => layer.id === id) ?? LAYERS[0];
