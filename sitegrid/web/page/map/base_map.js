// Layers beneath the map, where the page's server has them: a base map (a picture, or tiles), and the site's outline.
import { say } from "../cards/notice.js";
import { byId } from "../elements.js";
import { around, choices, site, view } from "../state/index.js";
import { ratio, stroke, trace } from "./pen.js";
import { redraw } from "./picture.js";

const TILE_PX = 256;
const COARSER = 2; // zooms that are drawn beneath, until the tiles of the right one have come
const ROUNDS = 5; // from the site to Web Mercator, each a hundred times closer
const MOST_TILES = 1000; // of one zoom: more are of a place where the fit means nothing
const images = new Map(); // by address
let waiting = 0, loaded = 0, isSaid = false;

export function showBackdrop() {
  const { attribution = "", problem } = site.backdrop;
  byId("attribution").textContent = attribution;
  if (problem) say("The site's outline and base map cannot be shown.", problem);
}

export function drawOutline(context) {
  for (const ring of site.backdrop?.outline ?? []) {
    trace(context, [...ring, ring[0]].map((place) => view.toScreen(...place)));
    stroke(context, choices.ink.halo, 4, 0.7);
    stroke(context, choices.ink.soft, 1.5);
  }
}

export function drawBaseMap(context) {
  const base = site.backdrop?.base_map;
  if (!base || !choices.shows.base) return;
  context.globalAlpha = Number(choices.ink.beneath);
  if (base.picture) drawImage(context, base.picture, base.corners);
  else {
    const zoom = Math.round(Math.log2((base.metres * view.scale * ratio()) / TILE_PX));
    const finest = Math.min(base.max_zoom, Math.max(0, zoom));
    for (let z = Math.max(0, finest - COARSER); z <= finest; z++) drawTiles(context, base, z);
  }
  context.globalAlpha = 1;
}

function drawTiles(context, base, z) {
  const { origin: [west, north], metres } = base, count = 2 ** z;
  const tileOf = (place) => {
    const [p, q] = worldOf(base, view.toSite(...place));
    return [(west + p / metres) * count, (north - q / metres) * count].map(Math.floor);
  };
  const tiles = [[0, 0], [view.width, 0], [0, view.height], [view.width, view.height]].map(tileOf);
  const [left, top, right, bottom] = around(tiles.map(([x, y]) => [x, y, x, y]));
  if (!((right - left + 1) * (bottom - top + 1) <= MOST_TILES)) return;
  const corner = (x, y) => siteOf(base, metres * (x / count - west), metres * (north - y / count));
  for (let y = top; y <= bottom; y++) for (let x = left; x <= right; x++) {
    const named = { "{z}": z, "{x}": ((x % count) + count) % count, "{y}": y };
    const address = base.tiles.replace(/\{[zxy]\}/g, (name) => named[name]);
    drawImage(context, address, [corner(x, y), corner(x + 1, y), corner(x, y + 1)]);
  }
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

// An image by its corners on the site: north-west, north-east, south-west. Whole pixels: tiles leave no seams.
function drawImage(context, address, corners) {
  const image = imageOf(address), { width, height } = image;
  if (!width) return;
  const [[x, y], [east, eastY], [south, southY]] =
    corners.map((place) => view.toScreen(...place).map((v) => Math.round(v * ratio())));
  context.save();
  context.transform((east - x) / width, (eastY - y) / width, (south - x) / height, (southY - y) / height, x, y);
  context.drawImage(image, 0, 0);
  context.restore();
}

function imageOf(address) {
  if (images.has(address)) return images.get(address);
  const image = Object.assign(new Image(), { onload: () => settle(1), onerror: () => settle(0), src: address });
  images.set(address, image);
  waiting++;
  return image;
}

// A tile may be missing where its server has none; where nothing comes at all, the page says so once.
function settle(count) {
  waiting--;
  loaded += count;
  redraw();
  if (waiting || loaded || isSaid) return;
  isSaid = true;
  say("The base map cannot be loaded.", "The map goes on without it.");
}
