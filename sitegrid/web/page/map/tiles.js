// A layer of the map: the ground's cells in colours, a small picture for each tile, painted anew where it changed.
import { CELLS, choices, shown, site, times, view } from "../state/index.js";
import { ratio } from "./pen.js";

const OLD_S = 7 * 86400, FAINTEST = 0.25; // what is a week old is at its faintest
const AGING_NS = 1e10; // ages are painted anew so often
const painted = new WeakMap(); // tile: its picture, and the style it has

export function drawTiles(context) {
  const { map, layer } = shown.map();
  if (layer.id === "difference") return draw(context, map, { layer, colour: layer.colour, key: "difference" });
  if (!times.isBeside) return draw(context, map, styleOf(map));
  const middle = Math.round(innerWidth * times.split) * ratio(), { width, height } = context.canvas;
  clipped(context, 0, middle, () => draw(context, times.otherMap, styleOf(times.otherMap)));
  clipped(context, middle, width - middle, () => draw(context, map, styleOf(map)));
  context.fillStyle = choices.ink.text;
  context.fillRect(middle - ratio(), 0, 2 * ratio(), height);
}

function clipped(context, left, width, paint) {
  context.save();
  context.beginPath();
  context.rect(left, 0, width, context.canvas.height);
  context.clip();
  paint();
  context.restore();
}

function styleOf(map) {
  const { layer, palette, shows, ink } = choices, now_ns = map === site.map ? times.now_ns : map.stamp_ns;
  const ages = layer.plane === "since" || shows.old ? Math.round(now_ns / AGING_NS) : "";
  return { layer, colour: choices.colour(site.boundaries), fades: shows.unsure ? layer.fades : null, old: shows.old,
    driven: parseInt(ink.driven.slice(1), 16), now_ns,
    key: [layer.id, palette, shows.unsure, shows.old, ink.driven, ages].join() };
}

function draw(context, map, style) {
  const side = CELLS * map.cell_m;
  context.imageSmoothingEnabled = view.scale * map.cell_m < 1.5;
  for (const tile of map.tiles.values()) {
    const [left, bottom] = view.toScreen(tile.x * side, tile.y * side).map((v) => Math.round(v * ratio()));
    const [right, top] = view.toScreen((tile.x + 1) * side, (tile.y + 1) * side).map((v) => Math.round(v * ratio()));
    if (right > 0 && bottom > 0 && left < context.canvas.width && top < context.canvas.height) {
      context.drawImage(pictureOf(map, tile, style), left, top, right - left, bottom - top);
    }
  }
}

function pictureOf(map, tile, style) {
  const had = painted.get(tile);
  if (had?.key === style.key) return had.picture;
  const picture = had?.picture ?? Object.assign(document.createElement("canvas"), { width: CELLS, height: CELLS });
  const pixels = new Uint8ClampedArray(pixelsOf(map, tile, style).buffer);
  picture.getContext("2d").putImageData(new ImageData(pixels, CELLS, CELLS), 0, 0);
  painted.set(tile, { picture, key: style.key });
  return picture;
}

function pixelsOf(map, tile, { layer, colour, fades, old, driven, now_ns }) {
  const plane = map.plane(tile, layer.plane), visits = map.plane(tile, "visits"), table = map.table.bind(map, tile);
  const colours = Uint32Array.from(table(layer.plane, now_ns), (v) => (Number.isNaN(v) ? 0 : swapped(colour(v))));
  const sure = fades && map.plane(tile, fades[0]);
  const opacity = fades && table(fades[0]).map((v) => opacityOf(fades[1](v)));
  const since = old && map.plane(tile, "since");
  const fresh = old && table("since", now_ns).map((s) => Math.max(FAINTEST, 1 - s / OLD_S));
  const onlyDriven = (swapped(driven) | 0xff000000) >>> 0;
  const pixels = new Uint32Array(CELLS * CELLS);
  for (let i = 0; i < pixels.length; i++) {
    // the first row of a tile is its southernmost, that of a picture its northernmost
    const out = (CELLS - 1 - Math.floor(i / CELLS)) * CELLS + (i % CELLS), q = plane[i];
    if (!q) { pixels[out] = visits[i] ? onlyDriven : 0; continue; }
    const alpha = (opacity ? opacity[sure[i]] : 255) * (old && since[i] ? fresh[since[i]] : 1);
    pixels[out] = ((colours[q] & 0xffffff) | (Math.round(alpha) << 24)) >>> 0;
  }
  return pixels;
}

const swapped = (rgb) => ((rgb & 255) << 16) | (rgb & 0xff00) | (rgb >> 16); // pixels in memory are red first
function opacityOf(sure) {
  const u = Math.min(1, Math.max(0, sure || 0)); // NaN: not known
  return 255 * (0.28 + 0.72 * u * u * (3 - 2 * u));
}
