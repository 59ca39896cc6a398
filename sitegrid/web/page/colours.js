// Colours of the ground: palettes turn a place along them, 0 to 1, into a colour.

const channels = (rgb) => [(rgb >> 16) & 255, (rgb >> 8) & 255, rgb & 255];
const bounded = (v) => Math.min(1, Math.max(0, v));
const linear = (v) => (v <= 0.04045 * 255 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4);
const gamma = (v) => Math.round(255 * bounded(v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));

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
  return (u) => fromLab(a.map((v, i) => v + bounded(u) * (b[i] - v)));
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
const kindOf = (value, boundaries) => boundaries.filter((boundary) => value >= boundary).length;
export const kindAt = (value, boundaries) => KINDS[Math.min(KINDS.length - 1, kindOf(value, boundaries))];
