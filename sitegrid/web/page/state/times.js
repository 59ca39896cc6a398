// The times that are shown: now or another one, played back, and two beside each other or subtracted.
import { clock, dayShort } from "../words.js";
import { getFrame } from "./door.js";
import { Owner } from "./owner.js";
import { site } from "./site.js";
import { TileMap } from "./tiles.js";

const MOST_STEPS = 240, KEPT = 96, FRAME_MS = 250;
const DAY_S = 86400, STEPS_S = [10, 60, 300, 900, 3600, 21600, DAY_S, 7 * DAY_S];
const MODES = ["one", "beside", "difference"];

// Tells of "times" (what is asked for), "maps" (what has come), "split" and "failed". A time of null is now.
class Times extends Owner {
  at = null;
  other = null; // to compare with
  mode = "one";
  map = null; // of the time; null for the live one
  otherMap = null;
  split = 0.5; // of the window's width, where two times meet
  steps = 1;
  step_ns = 0;
  playing = 0;
  error = null;
  #asking = new Map();
  #cache = new Map();

  get asOf() { return this.at ?? undefined; }
  get now_ns() { return this.at ?? site.map.stamp_ns; }
  get isBeside() { return this.mode === "beside" && this.otherMap !== null; }
  get isSubtracted() { return this.mode === "difference" && this.otherMap !== null; }

  // From the site's first to its newest time, in steps.
  span() {
    const { first_ns, stamp_ns } = site;
    if (!first_ns || first_ns >= stamp_ns) return;
    const fits = (s) => (stamp_ns - first_ns) / 1e9 / s <= MOST_STEPS;
    const step_ns = 1e9 * (STEPS_S.find(fits) ?? STEPS_S.at(-1));
    const steps = Math.max(1, Math.floor(stamp_ns / step_ns) - Math.floor(first_ns / step_ns));
    this.become("times", { step_ns, steps });
  }

  get #first() { return Math.floor(site.first_ns / this.step_ns); }
  timeOf(step) { return step >= this.steps ? null : (this.#first + 1 + Number(step)) * this.step_ns; }
  stepOf(ns) { return ns === null ? this.steps : Math.round(ns / this.step_ns) - this.#first - 1; }

  async go(ns) {
    this.become("times", { at: ns });
    if (ns === null) this.become("maps", { map: null });
    else await this.#want("map", "at");
  }

  // A thumb that is dragged passes many times: one is asked for at once, and then the newest that is wanted.
  async #want(name, time) {
    const ask = async () => {
      for (let ns = null; ns !== this[time] && this[time] !== null;) {
        ns = this[time];
        const map = await this.#fetch(ns);
        if (this[time] === ns) this.become("maps", { [name]: map });
      }
    };
    if (!this.#asking.has(name)) {
      this.#asking.set(name, ask().catch((error) => this.#fail(error)).finally(() => this.#asking.delete(name)));
    }
    return this.#asking.get(name);
  }

  // No map of that time: what is known is shown, the newest one.
  #fail(error) {
    this.goLive();
    this.become("failed", { error });
  }

  goLive() {
    Object.assign(this, { mode: "one", other: null, otherMap: null });
    this.go(null);
    this.stop();
  }

  async compareWith(ns, mode = "beside") {
    const other = ns ?? this.timeOf(this.steps - 1);
    this.become("times", { other, mode: this.mode === "one" ? mode : this.mode });
    await this.#want("otherMap", "other");
  }

  nextMode() {
    this.mode = MODES[(MODES.indexOf(this.mode) + 1) % MODES.length];
    if (this.mode === "one") this.other = this.otherMap = null;
    else if (this.other === null) return void this.compareWith(this.timeOf(Math.floor(this.steps / 2)));
    this.tell("times");
    this.tell("maps");
  }

  divide(share) { this.become("split", { split: Math.min(0.98, Math.max(0.02, share)) }); }
  step(by) { if (this.step_ns) this.go(this.timeOf(Math.max(0, this.stepOf(this.at) + by))); }

  play() {
    if (this.playing) return this.stop();
    if (this.at === null) this.at = this.timeOf(0);
    const next = async () => {
      const began = performance.now();
      await this.go(this.at);
      if (!this.playing) return;
      if (this.at === null) return this.stop();
      this.at = this.timeOf(this.stepOf(this.at) + 1);
      this.playing = setTimeout(next, Math.max(0, FRAME_MS - (performance.now() - began)));
    };
    this.become("times", { playing: setTimeout(next, 0) });
  }

  stop() {
    clearTimeout(this.playing);
    this.become("times", { playing: 0 });
  }

  async #fetch(ns) {
    if (!this.#cache.has(ns)) {
      const map = new TileMap();
      map.take(await getFrame(site.path("tiles"), { as_of: ns }));
      this.#cache.set(ns, map);
      if (this.#cache.size > KEPT) this.#cache.delete(this.#cache.keys().next().value);
    }
    return this.#cache.get(ns);
  }

  // A time in as many words as the site's span needs.
  words(ns) {
    if (ns === null) return "now";
    return site.stamp_ns - site.first_ns > DAY_S * 1e9 ? `${dayShort(ns)} ${clock(ns)}` : clock(ns, true);
  }
}

export const times = new Times();
