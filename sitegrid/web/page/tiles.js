// Tiles of 64 x 64 cells: planes of 8 bits as the map server sends them, painted here.

export const CELLS = 64;
const AREA = CELLS * CELLS;

// A frame: length of its JSON head (4 bytes, big-endian), the head, then the tiles' planes, deflated, end to end.
export async function readFrame(buffer) {
  const length = new DataView(buffer).getUint32(0);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  for (const tile of head.tiles) {
    const bytes = new Uint8Array(buffer, offset, tile.bytes);
    tile.planes = new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
    offset += tile.bytes;
  }
  return head;
}

// What a plane's 8 bits mean: 0 is unknown, 1 to 255 a value.
export function valuesOf(scale) {
  const values = new Float64Array(256).fill(NaN);
  for (let q = 1; q < 256; q++) {
    const u = (q - 1) / 254;
    if (scale.kind === "log") values[q] = scale.low * (scale.high / scale.low) ** u;
    else if (scale.kind === "linear") values[q] = scale.low + (scale.high - scale.low) * u;
    else if (scale.kind === "count") values[q] = q;
    else values[q] = scale.low * (2 ** ((q - 1) / scale.steps) - 1); // "since": seconds before the tile's newest sample
  }
  return values;
}

export class TileMap {
  constructor() { this.tiles = new Map(); this.planes = []; this.scales = {}; this.cell_m = 1; this.stamp_ns = 0; }

  // Take a frame. A whole one replaces everything, another only the tiles that it has.
  take(frame) {
    if (frame.whole) this.tiles.clear();
    Object.assign(this, { planes: frame.planes, scales: frame.scales, cell_m: frame.cell_m, store: frame.store, row: frame.row, fact: frame.fact, stamp_ns: frame.stamp_ns });
    this.values = Object.fromEntries(this.planes.map((name) => [name, valuesOf(this.scales[name])]));
    for (const tile of frame.tiles) {
      const key = `${tile.x},${tile.y}`, old = this.tiles.get(key);
      this.tiles.set(key, { ...tile, canvas: old?.canvas ?? null, painted: "" });
    }
  }

  plane(tile, name) { const i = this.planes.indexOf(name); return tile.planes.subarray(i * AREA, (i + 1) * AREA); }

  // Value of a plane in a cell; NaN where unknown. Age counts from `now_ns`.
  at(column, row, name, now_ns = this.stamp_ns) {
    const tile = this.tiles.get(`${Math.floor(column / CELLS)},${Math.floor(row / CELLS)}`);
    if (!tile) return NaN;
    const index = (row - tile.y * CELLS) * CELLS + column - tile.x * CELLS;
    if (name !== "age") return this.values[name][this.plane(tile, name)[index]];
    return this.values.since[this.plane(tile, "since")[index]] + Math.max(0, (now_ns - tile.newest_ns) / 1e9);
  }

  bounds() {
    let box = null;
    for (const tile of this.tiles.values()) {
      if (tile.box === undefined) tile.box = this.boxOf(tile); // once: the view asks several times a second
      box = box && tile.box ? box.map((edge, i) => (i < 2 ? Math.min : Math.max)(edge, tile.box[i])) : box ?? tile.box;
    }
    return box && box.map((v) => v * this.cell_m);
  }

  boxOf(tile) {
    const visits = this.plane(tile, "visits");
    let box = null;
    for (let i = 0; i < AREA; i++) if (visits[i]) {
      const x = tile.x * CELLS + (i % CELLS), y = tile.y * CELLS + Math.floor(i / CELLS);
      box = box ? [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x + 1), Math.max(box[3], y + 1)] : [x, y, x + 1, y + 1];
    }
    return box;
  }

  // How many cells each of `bins` parts of a layer's palette has, and how many are known.
  histogram(layer, bins, now_ns) {
    const counts = new Array(bins).fill(0);
    let known = 0;
    for (const tile of this.tiles.values()) {
      const values = this.table(tile, layer, now_ns), plane = this.plane(tile, planeOf(layer.id)), visits = this.plane(tile, "visits");
      const bin = values.map((v) => Math.min(bins - 1, Math.max(0, Math.floor(layer.at(v) * bins))));
      for (let i = 0; i < AREA; i++) {
        if (visits[i]) known++;
        if (plane[i]) counts[bin[plane[i]]]++;
      }
    }
    return { counts, known };
  }

  // The value of each of a plane's 256 steps, for one tile.
  table(tile, layer, now_ns) {
    if (layer.id !== "age") return this.values[layer.id];
    const since_s = Math.max(0, (now_ns - tile.newest_ns) / 1e9);
    return this.values.since.map((v) => v + since_s);
  }

  // Paint what is not painted as `style` says: {layer, colour, fade, old, driven, now_ns, key}.
  paint(style) {
    for (const tile of this.tiles.values()) {
      const ages = style.layer.id === "age" || style.old;
      const key = ages ? `${style.key}|${Math.round(style.now_ns / 1e10)}` : style.key;
      if (tile.painted !== key) { this.paintTile(tile, style); tile.painted = key; }
    }
  }

  paintTile(tile, style) {
    tile.canvas ??= Object.assign(document.createElement("canvas"), { width: CELLS, height: CELLS });
    const context = tile.canvas.getContext("2d"), image = context.createImageData(CELLS, CELLS);
    const pixels = new Uint32Array(image.data.buffer);
    const plane = this.plane(tile, planeOf(style.layer.id)), values = this.table(tile, style.layer, style.now_ns);
    const colours = Uint32Array.from(values, (v) => (Number.isNaN(v) ? 0 : swapped(style.colour(v))));
    const fades = style.fade && style.layer.fades ? this.plane(tile, style.layer.fades) : null;
    const opacity = fades && opacityOf(style.layer.fades, this.values[style.layer.fades]);
    const since = style.old ? this.plane(tile, "since") : null;
    const fresh = since && this.table(tile, { id: "age" }, style.now_ns).map((s) => Math.max(0.25, 1 - s / (7 * 86400)));
    const visits = this.plane(tile, "visits"), driven = (swapped(style.driven) | 0xff000000) >>> 0;
    for (let row = 0; row < CELLS; row++) {
      const out = (CELLS - 1 - row) * CELLS; // the first row of a tile is its southernmost, that of a picture its northernmost
      for (let column = 0; column < CELLS; column++) {
        const i = row * CELLS + column, q = plane[i];
        if (!q) { pixels[out + column] = visits[i] ? driven : 0; continue; }
        let alpha = opacity ? opacity[fades[i]] : 255;
        if (fresh && since[i]) alpha *= fresh[since[i]];
        pixels[out + column] = ((colours[q] & 0xffffff) | (Math.round(alpha) << 24)) >>> 0;
      }
    }
    context.putImageData(image, 0, 0);
  }

  draw(context, view, ratio) {
    const side = CELLS * this.cell_m;
    context.imageSmoothingEnabled = view.scale * this.cell_m < 1.5;
    for (const tile of this.tiles.values()) {
      const [left, bottom] = view.toScreen(tile.x * side, tile.y * side).map((v) => Math.round(v * ratio));
      const [right, top] = view.toScreen((tile.x + 1) * side, (tile.y + 1) * side).map((v) => Math.round(v * ratio));
      if (tile.canvas && right > 0 && bottom > 0 && left < context.canvas.width && top < context.canvas.height) {
        context.drawImage(tile.canvas, left, top, right - left, bottom - top);
      }
    }
  }
}

// Difference of two maps of one layer, as a map of its own that `paint` understands.
export function difference(newer, older, layer) {
  const result = new TileMap();
  Object.assign(result, { planes: ["difference", "visits"], cell_m: newer.cell_m, stamp_ns: newer.stamp_ns });
  result.values = { difference: valuesOf({ kind: "linear", low: -1, high: 1 }), visits: valuesOf({ kind: "count" }) };
  for (const [key, tile] of newer.tiles) {
    const planes = new Uint8Array(2 * AREA), other = older.tiles.get(key);
    if (other) {
      const now = newer.plane(tile, planeOf(layer.id)), then = older.plane(other, planeOf(layer.id));
      const nowValues = newer.table(tile, layer, newer.stamp_ns), thenValues = older.table(other, layer, older.stamp_ns);
      for (let i = 0; i < AREA; i++) if (now[i] && then[i]) {
        const u = layer.change[0](nowValues[now[i]], thenValues[then[i]]);
        planes[i] = 1 + Math.round(127 * (Math.min(1, Math.max(-1, u)) + 1));
        planes[AREA + i] = 1;
      }
    }
    result.tiles.set(key, { ...tile, planes, canvas: null, painted: "" });
  }
  return result;
}

const planeOf = (id) => (id === "age" ? "since" : id);
const swapped = (rgb) => ((rgb & 255) << 16) | (rgb & 0xff00) | (rgb >> 16); // pixels in memory are red first
function opacityOf(name, values) {
  // A share of 40 % of the votes, or a deviation of 10 % of slope, is hardly more than a guess.
  const sure = name === "confidence" ? (v) => (v - 0.4) / 0.5 : (v) => (0.1 - v) / 0.08;
  return values.map((v) => { const u = Math.min(1, Math.max(0, Number.isNaN(v) ? 0 : sure(v))); return 255 * (0.28 + 0.72 * u * u * (3 - 2 * u)); });
}
