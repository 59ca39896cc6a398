// The view: where on the screen a place of the site is; and the fingers, wheel and keys that move it.

const CLOSEST = 80, FARTHEST = 0.05; // pixels per metre
const FLIGHT_MS = 420;

export class View {
  constructor() { Object.assign(this, { x: 0, y: 0, scale: 4, width: 1, height: 1, margins: [0, 0, 0, 0], moved: false, flight: null }); }

  toScreen(x, y) { return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale]; }
  toSite(left, top) { return [this.x + (left - this.width / 2) / this.scale, this.y - (top - this.height / 2) / this.scale]; }

  zoom(factor, left = this.width / 2, top = this.height / 2) {
    const [x, y] = this.toSite(left, top);
    this.scale = Math.min(CLOSEST, Math.max(FARTHEST, this.scale * factor));
    this.x = x - (left - this.width / 2) / this.scale;
    this.y = y + (top - this.height / 2) / this.scale;
    this.moved = true;
    this.flight = null;
  }

  shift(right, down) { this.flight = null; this.x -= right / this.scale; this.y += down / this.scale; this.moved = true; }

  // Show a box of the site within the margins (left, top, right, bottom) that cards leave free.
  fit(box) { Object.assign(this, this.fitted(box, this.margins), { moved: false, flight: null }); }

  fitted([west, south, east, north], [left, top, right, bottom]) {
    const width = Math.max(50, this.width - left - right), height = Math.max(50, this.height - top - bottom);
    const scale = Math.min(20, Math.max(FARTHEST, Math.min(width / (east - west), height / (north - south))));
    return { scale, x: (west + east) / 2 - (left - right) / 2 / scale, y: (south + north) / 2 + (top - bottom) / 2 / scale };
  }

  // Go to a box within margins, in a moment or, where nothing is to move, at once.
  fly(box, margins, moves) {
    this.flight = { from: { x: this.x, y: this.y, scale: this.scale }, to: this.fitted(box, margins), began_ms: performance.now(), ms: moves ? FLIGHT_MS : 0 };
    this.moved = true;
  }

  // The next picture of a flight; false where there is none.
  advance(now_ms) {
    if (!this.flight) return false;
    const { from, to, began_ms, ms } = this.flight, u = ms ? Math.min(1, Math.max(0, (now_ms - began_ms) / ms)) : 1, part = 1 - (1 - u) ** 3;
    this.scale = from.scale * (to.scale / from.scale) ** part;
    this.x = from.x + part * (to.x - from.x);
    this.y = from.y + part * (to.y - from.y);
    if (u === 1) this.flight = null;
    return true;
  }
}

// Pointers on the map: `changed` after it moved, `rest(left, top)` where a mouse is, `choose(left, top)` on a click or tap;
// what begins where `holds(left)` goes to `divide(left)` and moves no map.
export function follow(canvas, view, { changed, rest, choose, holds, divide }) {
  const pointers = new Map();
  let travelled = 0, spread = 0, held = false;
  const middle = () => { const all = [...pointers.values()]; return [0, 1].map((axis) => all.reduce((sum, p) => sum + p[axis], 0) / all.length); };
  const apart = () => { const [a, b] = [...pointers.values()]; return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0; };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!pointers.size) { travelled = 0; held = holds(event.clientX); }
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    spread = apart();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) { canvas.classList.toggle("divides", holds(event.clientX)); return rest(event.clientX, event.clientY); }
    if (held) { travelled += 9; rest(null); return divide(event.clientX); }
    const before = middle();
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = middle(), right = after[0] - before[0], down = after[1] - before[1];
    travelled += Math.hypot(right, down);
    if (travelled < 4 && pointers.size === 1) return;
    canvas.classList.add("drag");
    view.shift(right, down);
    if (pointers.size === 2 && spread) { view.zoom(apart() / spread, ...after); spread = apart(); travelled += 9; }
    rest(null);
    changed();
  });
  const up = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    canvas.classList.remove("drag");
    spread = apart();
    if (!pointers.size && travelled < 4 && event.type === "pointerup") choose(event.clientX, event.clientY);
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointerleave", () => rest(null));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), event.clientX, event.clientY);
    changed();
  }, { passive: false });
}
