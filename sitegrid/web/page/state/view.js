// The view: where on the screen a place of the site is.
import { Owner } from "./owner.js";

const CLOSEST = 80, FARTHEST = 0.05, USUAL = 20; // pixels per metre; USUAL: no site is fitted closer
const FLIGHT_MS = 420;

// Tells of "view".
class View extends Owner {
  x = 0;
  y = 0;
  scale = 4; // pixels per metre
  width = 1;
  height = 1;
  margins = [0, 0, 0, 0]; // left, top, right, bottom: what cards cover
  moved = false; // by somebody: it is not fitted any more
  flight = null;

  toScreen(x, y) { return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale]; }
  toSite(left, top) {
    return [this.x + (left - this.width / 2) / this.scale, this.y - (top - this.height / 2) / this.scale];
  }

  size(width, height) { Object.assign(this, { width, height }); }

  zoom(factor, left = this.width / 2, top = this.height / 2) {
    const [x, y] = this.toSite(left, top), scale = Math.min(CLOSEST, Math.max(FARTHEST, this.scale * factor));
    this.look(x - (left - this.width / 2) / scale, y + (top - this.height / 2) / scale, scale);
  }

  shift(right, down) { this.look(this.x - right / this.scale, this.y + down / this.scale); }
  look(x, y, scale = this.scale) { this.become("view", { x, y, scale, moved: true, flight: null }); }

  // Show a box of the site within the margins that cards leave free.
  fit(box, margins) { this.become("view", { ...this.#fitted(box, margins), margins, moved: false, flight: null }); }

  #fitted([west, south, east, north], [left, top, right, bottom]) {
    const width = Math.max(50, this.width - left - right), height = Math.max(50, this.height - top - bottom);
    const scale = Math.min(USUAL, Math.max(FARTHEST, Math.min(width / (east - west), height / (north - south))));
    const x = (west + east) / 2 - (left - right) / 2 / scale, y = (south + north) / 2 + (top - bottom) / 2 / scale;
    return { scale, x, y };
  }

  // Go to a box within margins, in a moment or, where nothing is to move, at once. moved: by somebody.
  fly(box, margins, moved = true) {
    const { x, y, scale } = this, ms = matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : FLIGHT_MS;
    const flight = { from: { x, y, scale }, to: this.#fitted(box, margins), began_ms: performance.now(), ms };
    this.become("view", { flight, moved });
  }

  // The next picture of a flight, if there is one.
  advance() {
    if (!this.flight) return;
    const { from, to, began_ms, ms } = this.flight;
    const u = ms ? Math.min(1, Math.max(0, (performance.now() - began_ms) / ms)) : 1, part = 1 - (1 - u) ** 3;
    const scale = from.scale * (to.scale / from.scale) ** part;
    const x = from.x + part * (to.x - from.x), y = from.y + part * (to.y - from.y);
    this.become("view", { scale, x, y, flight: u === 1 ? null : this.flight });
  }
}

export const view = new View();
