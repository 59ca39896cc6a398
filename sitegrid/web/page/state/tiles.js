// Tiles of 64 x 64 cells: planes of 8 bits as the map server sends them.

export const CELLS = 64;
const AREA = CELLS * CELLS;

// A frame: length of its JSON head (4 bytes, big-endian), the head, then the tiles' planes, deflated, end to end.
export async function readFrame(buffer) {
  const length = new DataView(buffer).getUint32(0);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const tiles = [];
  let offset = 4 + length;
  for (const { bytes, ...tile } of head.tiles) {
    const deflated = new Blob([new Uint8Array(buffer, offset, bytes)]).stream();
    const planes = await new Response(deflated.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
    tiles.push({ ...tile, planes: new Uint8Array(planes) });
    offset += bytes;
  }
  return { ...head, tiles };
}

// What a plane's 8 bits mean: 0 is unknown, 1 to 255 a value.
function valuesOf(scale) {
  const values = new Float64Array(256).fill(NaN);
  for (let q = 1; q < 256; q++) {
    const u = (q - 1) / 254;
    if (scale.kind === "log") values[q] = scale.low * (scale.high / scale.low) ** u;
    else if (scale.kind === "linear") values[q] = scale.low + (scale.high - scale.low) * u;
    else if (scale.kind === "count") values[q] = q;
    else values[q] = scale.low * (2 ** ((q - 1) / scale.steps) - 1); // "since": seconds before a tile's newest sample
  }
  return values;
}

// The least box around boxes [west, south, east, north]; undefined where there is none.
export const around = (boxes) =>
  (boxes.length ? [0, 1, 2, 3].map((i) => (i < 2 ? Math.min : Math.max)(...boxes.map((box) => box[i]))) : undefined);

export class TileMap {
  tiles = new Map();
  planes = [];
  values = {}; // by plane: what its 256 steps mean
  cell_m = 1;
  stamp_ns = 0;

  // Take a frame. A whole one replaces everything, another only the tiles that it has.
  take({ whole, tiles, scales, planes, cell_m, store, row, fact, stamp_ns }) {
    if (whole) this.tiles.clear();
    Object.assign(this, { planes, cell_m, store, row, fact, stamp_ns });
    this.values = Object.fromEntries(planes.map((name) => [name, valuesOf(scales[name])]));
    for (const tile of tiles) this.tiles.set(`${tile.x},${tile.y}`, tile);
  }

  plane(tile, name) {
    const i = this.planes.indexOf(name);
    return tile.planes.subarray(i * AREA, (i + 1) * AREA);
  }

  knows(name) { return [...this.tiles.values()].some((tile) => this.plane(tile, name).some(Boolean)); }

  // Value of a plane in a cell; NaN where unknown.
  at(column, row, name) {
    const tile = this.tiles.get(`${Math.floor(column / CELLS)},${Math.floor(row / CELLS)}`);
    if (!tile) return NaN;
    return this.values[name][this.plane(tile, name)[(row - tile.y * CELLS) * CELLS + column - tile.x * CELLS]];
  }

  bounds() { // each tile's are looked up once: the view asks several times a second
    for (const tile of this.tiles.values()) if (!("box" in tile)) tile.box = this.#boxOf(tile);
    const boxes = [...this.tiles.values()].map((tile) => tile.box).filter(Boolean);
    return around(boxes)?.map((edge) => edge * this.cell_m);
  }

  #boxOf(tile) {
    const visits = this.plane(tile, "visits");
    let [west, south, east, north] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = 0; i < AREA; i++) if (visits[i]) {
      const x = tile.x * CELLS + (i % CELLS), y = tile.y * CELLS + Math.floor(i / CELLS);
      [west, south] = [Math.min(west, x), Math.min(south, y)];
      [east, north] = [Math.max(east, x + 1), Math.max(north, y + 1)];
    }
    return east > west ? [west, south, east, north] : undefined;
  }

  // How many cells each of `bins` parts of a layer's palette has, and how many are known.
  histogram(layer, bins, now_ns) {
    const counts = new Array(bins).fill(0);
    let known = 0;
    for (const tile of this.tiles.values()) {
      const plane = this.plane(tile, layer.plane), visits = this.plane(tile, "visits");
      const bin = this.table(tile, layer.plane, now_ns)
        .map((v) => Math.min(bins - 1, Math.max(0, Math.floor(layer.at(v) * bins))));
      for (let i = 0; i < AREA; i++) {
        if (visits[i]) known++;
        if (plane[i]) counts[bin[plane[i]]]++;
      }
    }
    return { counts, known };
  }

  // The value of each of a plane's 256 steps, for one tile; ages count from `now_ns`.
  table(tile, name, now_ns) {
    if (name !== "since") return this.values[name];
    const since_s = Math.max(0, (now_ns - tile.newest_ns) / 1e9);
    return this.values.since.map((v) => v + since_s);
  }
}

// Difference of two maps of one layer, as a map of its own that is painted as others are.
export function difference(newer, older, layer) {
  const result = new TileMap(), tiles = [];
  for (const [key, tile] of newer.tiles) {
    const planes = new Uint8Array(2 * AREA), other = older.tiles.get(key);
    if (other) {
      const now = newer.plane(tile, layer.plane), then = older.plane(other, layer.plane);
      const nowValues = newer.table(tile, layer.plane, newer.stamp_ns);
      const thenValues = older.table(other, layer.plane, older.stamp_ns);
      for (let i = 0; i < AREA; i++) if (now[i] && then[i]) {
        const u = layer.change[0](nowValues[now[i]], thenValues[then[i]]);
        planes[i] = 1 + Math.round(127 * (Math.min(1, Math.max(-1, u)) + 1));
        planes[AREA + i] = 1;
      }
    }
    tiles.push({ ...tile, planes });
  }
  const scales = { difference: { kind: "linear", low: -1, high: 1 }, visits: { kind: "count" } };
  result.take({ ...newer, tiles, planes: Object.keys(scales), scales });
  return result;
}
