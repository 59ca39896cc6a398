// The time bar: the map as of another time, play-back, and two times beside each other or subtracted.
import { getFrame } from "./live.js";
import { byId, clock, day, dayShort } from "./parts.js";
import { TileMap } from "./tiles.js";

const MOST_STEPS = 240, KEPT = 96, FRAME_MS = 250, TICK_PX = 84;
const STEPS_S = [10, 60, 300, 900, 3600, 21600, 86400, 604800], DAY_S = 86400;
const TICKS_S = [10, 30, 60, 120, 180, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, DAY_S, 2 * DAY_S, 7 * DAY_S, 14 * DAY_S, 28 * DAY_S, 56 * DAY_S, 91 * DAY_S, 364 * DAY_S];
export const MODES = ["one", "beside", "difference"];

export class TimeBar {
  // page: path(name), redraw(), changes. shown: called with the map of the chosen time, null for the live one.
  constructor(page) {
    Object.assign(this, { page, first_ns: 0, last_ns: 0, at: null, other: null, mode: "one", playing: 0, asking: new Map(), cache: new Map(), map: null, otherMap: null, split: 0.5 });
    this.slider = byId("slider");
    this.second = byId("slider-two");
    this.slider.addEventListener("input", () => this.go(this.timeOf(this.slider.value)));
    this.second.addEventListener("input", () => this.compareWith(this.timeOf(this.second.value)));
    byId("play").addEventListener("click", () => this.play());
    byId("live").addEventListener("click", () => this.goLive());
    byId("compare").addEventListener("click", () => this.nextMode());
  }

  // The site's first and newest time.
  span(first_ns, last_ns) {
    if (!first_ns || first_ns >= last_ns) return;
    const step_s = STEPS_S.find((s) => (last_ns - first_ns) / 1e9 / s <= MOST_STEPS) ?? STEPS_S.at(-1);
    Object.assign(this, { first_ns, last_ns, step_ns: step_s * 1e9 });
    const steps = Math.max(1, Math.floor(last_ns / this.step_ns) - Math.floor(first_ns / this.step_ns));
    for (const input of [this.slider, this.second]) input.max = steps;
    this.show();
  }

  timeOf(step) { return Number(step) >= Number(this.slider.max) ? null : (Math.floor(this.first_ns / this.step_ns) + 1 + Number(step)) * this.step_ns; }
  stepOf(ns) { return ns === null ? Number(this.slider.max) : Math.round(ns / this.step_ns) - Math.floor(this.first_ns / this.step_ns) - 1; }

  // A thumb that is dragged passes many times: one is asked for at once, and then the newest that is wanted.
  async go(ns) {
    this.at = ns;
    this.show();
    if (ns === null) this.take("map", null);
    else await this.want("map", () => this.at);
  }

  async want(name, wanted) {
    if (this.asking.has(name)) return this.asking.get(name);
    const ask = async () => {
      for (let ns = null; ns !== wanted() && wanted() !== null;) {
        ns = wanted();
        let map;
        try { map = await this.fetch(ns); } catch (error) { this.failed(error); return; }
        if (wanted() === ns) this.take(name, map);
      }
    };
    this.asking.set(name, ask().finally(() => this.asking.delete(name)));
    return this.asking.get(name);
  }

  take(name, map) { this[name] = map; this.page.mapChanged(); }

  // No map of that time: say so, and show what is known, the newest one.
  failed(error) {
    this.goLive();
    this.page.say("The map of that time could not be read", error.message);
  }

  goLive() { this.mode = "one"; this.other = this.otherMap = null; this.go(null); this.stop(); }

  async compareWith(ns) {
    this.other = ns ?? this.timeOf(this.slider.max - 1);
    if (this.mode === "one") this.mode = "beside";
    this.show();
    await this.want("otherMap", () => this.other);
  }

  nextMode() {
    this.mode = MODES[(MODES.indexOf(this.mode) + 1) % MODES.length];
    if (this.mode === "one") this.other = this.otherMap = null;
    else if (this.other === null) return this.compareWith(this.timeOf(Math.floor(this.slider.max / 2)));
    this.show();
    this.page.mapChanged();
  }

  step(by) { if (this.step_ns) this.go(this.timeOf(Math.min(Number(this.slider.max), Math.max(0, this.stepOf(this.at) + by)))); }

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
    this.playing = setTimeout(next, 0);
    this.show();
  }

  stop() { clearTimeout(this.playing); this.playing = 0; this.show(); }

  async fetch(ns) {
    const key = `${this.page.site}|${ns}`;
    if (!this.cache.has(key)) {
      const map = new TileMap();
      map.take(await getFrame(this.page.path("tiles"), { as_of: ns }));
      this.cache.set(key, map);
      if (this.cache.size > KEPT) this.cache.delete(this.cache.keys().next().value);
    }
    return this.cache.get(key);
  }

  // A time in as many words as the site's span needs.
  words(ns) { return ns === null ? "now" : this.last_ns - this.first_ns > DAY_S * 1e9 ? `${dayShort(ns)} ${clock(ns)}` : clock(ns, true); }

  show() {
    const [time, date] = byId("clock").children, ns = this.at ?? this.last_ns;
    time.textContent = ns ? clock(ns, true) : "--:--";
    date.textContent = ns ? `${day(ns)}${this.at === null ? ", now" : ""}` : "";
    this.slider.value = this.stepOf(this.at);
    this.slider.setAttribute("aria-valuetext", ns ? `${day(ns)} ${clock(ns)} UTC` : "no time known");
    this.second.hidden = this.mode === "one";
    if (this.other !== null && this.step_ns) this.second.value = this.stepOf(this.other);
    byId("compare").textContent = { one: "Compare", beside: "Beside", difference: "Difference" }[this.mode];
    byId("compare").setAttribute("aria-pressed", this.mode !== "one");
    byId("live").setAttribute("aria-pressed", this.at === null);
    const play = byId("play");
    play.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    play.querySelector("path").setAttribute("d", this.playing ? "M5 4h4v12H5zM11 4h4v12h-4z" : "M6 4l10 6-10 6z");
    this.drawStrip();
    this.page.timeMoved();
  }

  // A line from the first sample to now, ticks of time, a diamond for each change of the ground.
  drawStrip() {
    const canvas = byId("strip"), ratio = Math.min(2, devicePixelRatio || 1), width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const context = canvas.getContext("2d"), { ink } = this.page;
    context.scale(ratio, ratio);
    if (!this.step_ns || !ink) return;
    const x = (ns) => width * (ns - this.first_ns) / (this.last_ns - this.first_ns), middle = height / 2;
    context.fillStyle = ink.hatch;
    context.fillRect(0, middle - 2, width, 4);
    context.fillStyle = ink.text;
    context.fillRect(0, middle - 2, x(this.at ?? this.last_ns), 4);
    context.font = `11px ${getComputedStyle(document.body).fontFamily}`;
    context.fillStyle = ink.soft;
    context.textAlign = "center";
    const span_ns = this.last_ns - this.first_ns, most = Math.max(1, Math.floor(width / TICK_PX));
    const tick_ns = 1e9 * (TICKS_S.find((s) => span_ns / 1e9 / s <= most) ?? TICKS_S.at(-1));
    for (let ns = Math.ceil(this.first_ns / tick_ns) * tick_ns; ns < this.last_ns; ns += tick_ns) {
      if (x(ns) < 24 || x(ns) > width - 24) continue;
      const midnight = ns % (DAY_S * 1e9) === 0;
      context.fillText(midnight || tick_ns >= DAY_S * 1e9 ? dayShort(ns) : clock(ns, tick_ns < 60e9), x(ns), height - 1);
    }
    context.fillStyle = ink.alarm;
    for (const change of this.page.changes) {
      const at = x(change.first_ns);
      context.beginPath();
      context.moveTo(at, 1); context.lineTo(at + 5, 6); context.lineTo(at, 11); context.lineTo(at - 5, 6);
      context.fill();
    }
  }
}
