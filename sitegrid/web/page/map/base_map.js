// Layers beneath the map: a base map, which the page's server names or a file of this tab is, and the site's outline.
import { say } from "../cards/notice.js";
import { byId } from "../elements.js";
import { around, choices, site, view } from "../state/index.js";
import { drawPicture, ratio, stroke, trace } from "./pen.js";
import { redraw } from "./picture.js";

const TILE_PX = 256, KEPT = 1000; // a tile's side; tiles that are kept
const COARSER = 2; // zooms that are drawn beneath, until the tiles of the right one have come
const ROUNDS = 5; // from the site to Web Mercator, each a hundred times closer
const MOST_TILES = 1000; // of one zoom: more are of a place where the fit means nothing
const tiles = new Map(); // images by address
let picture = null; // {image, corners}: north-west, north-east, south-west [m]
let waiting = 0, loaded = 0, isSaid = false;

// Take what the page's server says.
export function showBackdrop() {
  const { base_map: base, attribution, problem } = site.backdrop;
  if (problem) return say("The site's outline and base map cannot be shown", problem);
  byId("attribution").textContent = attribution;
  if (base?.picture) picture = { image: load(base.picture), corners: base.corners };
  redraw();
}

// Lay a picture of this tab beneath, by its world file: pixel (column, row) is at a*column + b*row + c, d*column + ...
export async function readPicture(files) {
  const file = files.find(({ type }) => type.startsWith("image/"));
  const world = files.find(({ name }) => /\.(pgw|jgw|wld)$/i.test(name));
  if (!file || !world) throw new Error("Choose the picture and its world file (.pgw, .jgw or .wld) together.");
  const lines = (await world.text()).trim().split(/\s+/).map(Number), [a, d, b, e, c, f] = lines;
  if (lines.length !== 6 || !lines.every(Number.isFinite) || a * e === d * b) {
    throw new Error(`${world.name} is no world file: six numbers, in metres of the site.`);
  }
  const image = await createImageBitmap(file), { width, height } = image;
  const at = (column, row) => [a * (column - 0.5) + b * (row - 0.5) + c, d * (column - 0.5) + e * (row - 0.5) + f];
  picture = { image, corners: [at(0, 0), at(width, 0), at(0, height)] };
  choices.setShow("base", true);
}

function load(address) {
  const image = new Image();
  waiting++;
  image.onload = () => { loaded++; settle(); };
  image.onerror = settle;
  image.src = address;
  return image;
}

// Tiles beyond what a server has may be missing; where nothing comes at all, the page says so once.
function settle() {
  waiting--;
  redraw();
  if (waiting || loaded || isSaid) return;
  isSaid = true;
  say("The base map cannot be loaded.", "The map goes on without it.");
}

export function drawBaseMap(context) {
  const base = site.backdrop?.base_map;
  if (!choices.shows.base) return;
  context.globalAlpha = Number(choices.ink.beneath);
  if (picture?.image.width) drawPicture(context, picture.image, picture.corners.map(pixels));
  else if (base?.tiles) drawTiles(context, base);
  context.globalAlpha = 1;
}

const pixels = (place) => view.toScreen(...place).map((v) => Math.round(v * ratio())); // whole: tiles leave no seams

function drawTiles(context, base) {
  const zoom = Math.round(Math.log2((base.metres * view.scale * ratio()) / TILE_PX));
  const finest = Math.min(base.max_zoom, Math.max(0, zoom));
  for (let z = Math.max(0, finest - COARSER); z <= finest; z++) drawZoom(context, base, z, z === finest);
}

function drawZoom(context, base, z, isWanted) {
  const { origin: [west, north], metres } = base, count = 2 ** z;
  const tileOf = (place) => {
    const [p, q] = worldOf(base, view.toSite(...place));
    return [(west + p / metres) * count, (north - q / metres) * count].map(Math.floor);
  };
  const places = [[0, 0], [view.width, 0], [0, view.height], [view.width, view.height]].map(tileOf);
  const [left, top, right, bottom] = around(places.map(([x, y]) => [x, y, x, y]));
  if (!((right - left + 1) * (bottom - top + 1) <= MOST_TILES)) return;
  const corner = (x, y) => pixels(siteOf(base, metres * (x / count - west), metres * (north - y / count)));
  for (let y = top; y <= bottom; y++) for (let x = left; x <= right; x++) {
    const image = tile(base.tiles, z, ((x % count) + count) % count, y, isWanted);
    if (image?.width) drawPicture(context, image, [corner(x, y), corner(x + 1, y), corner(x, y + 1)]);
  }
}

function tile(template, z, x, y, isWanted) {
  const address = template.replace("{z}", z).replace("{x}", x).replace("{y}", y);
  if (isWanted && !tiles.has(address)) tiles.set(address, load(address));
  if (tiles.size > KEPT) tiles.delete(tiles.keys().next().value);
  return tiles.get(address);
}

// From metres east and north of the site's origin in Web Mercator to metres of the site, and back.
function siteOf({ fit }, p, q) {
  const terms = [1, p, q, p * p, p * q, q * q];
  return fit.map((factors) => factors.reduce((sum, factor, i) => sum + factor * terms[i], 0));
}
function worldOf(base, [x, y]) {
  let [p, q] = [x, y];
  for (let i = 0; i < ROUNDS; i++) {
    const [reachedX, reachedY] = siteOf(base, p, q);
    [p, q] = [p + x - reachedX, q + y - reachedY];
  }
  return [p, q];
}

export function drawOutline(context) {
  for (const ring of site.backdrop?.outline ?? []) {
    trace(context, [...ring, ring[0]].map((place) => view.toScreen(...place)));
    stroke(context, choices.ink.halo, 4, 0.7);
    stroke(context, choices.ink.soft, 1.5);
  }
}
