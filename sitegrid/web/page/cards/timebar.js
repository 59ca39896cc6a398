// Card: the time that is shown, its slider, and the site's activity beneath.
import { byId } from "../elements.js";
import { font, sized } from "../map/pen.js";
import { choices, site, times } from "../state/index.js";
import { clock, day, dayShort } from "../words.js";

const TICK_PX = 84, EDGE_PX = 24, DAY_NS = 86400e9;
const DAYS = [1, 2, 7, 14, 28, 56, 91, 364].map((days) => days * DAY_NS);
const MINUTES = [1, 2, 3, 5, 10, 15, 30, 60, 120, 180, 360, 720].map((minutes) => minutes * 60e9);
const TICKS_NS = [10e9, 30e9, ...MINUTES, ...DAYS];
const PLAY = "M6 4l10 6-10 6z", PAUSE = "M5 4h4v12H5zM11 4h4v12h-4z";
const NEXT = { one: "Side by side", beside: "Difference", difference: "One time" }; // by mode: what the button does
const slider = byId("slider"), second = byId("slider-two");

export function buildTimebar() {
  slider.addEventListener("input", () => times.go(times.timeOf(slider.value)));
  second.addEventListener("input", () => times.compareWith(times.timeOf(second.value)));
  byId("play").onclick = () => times.play();
  byId("live").onclick = () => times.goLive();
  byId("compare").onclick = () => times.nextMode();
}

export function showTimebar() {
  const [time, date] = byId("clock").children, { at, other, mode, steps } = times, ns = at ?? site.stamp_ns;
  time.textContent = ns ? clock(ns, true) : "--:--";
  date.textContent = ns ? `${day(ns)}${at === null ? ", now" : ""}` : "";
  slider.max = second.max = steps;
  slider.value = times.stepOf(at);
  slider.setAttribute("aria-valuetext", ns ? `${day(ns)} ${clock(ns)} UTC` : "no time known");
  second.hidden = mode === "one";
  if (other !== null && times.step_ns) second.value = times.stepOf(other);
  byId("compare").textContent = NEXT[mode];
  byId("live").setAttribute("aria-pressed", at === null);
  byId("play").setAttribute("aria-label", times.playing ? "Pause" : "Play");
  byId("play").querySelector("path").setAttribute("d", times.playing ? PAUSE : PLAY);
  drawStrip();
}

// A line from the first sample to now, ticks of time, a diamond for each change of the ground.
export function drawStrip() {
  const canvas = byId("strip"), { clientWidth: width, clientHeight: height } = canvas;
  const context = sized(canvas, width, height), { ink } = choices, middle = height / 2;
  if (!times.step_ns) return;
  const { first_ns, stamp_ns } = site, x = (ns) => width * (ns - first_ns) / (stamp_ns - first_ns);
  for (const [colour, end] of [[ink.hatch, width], [ink.text, x(times.at ?? stamp_ns)]]) {
    context.fillStyle = colour;
    context.fillRect(0, middle - 2, end, 4);
  }
  font(context, "11px");
  context.fillStyle = ink.soft;
  context.textAlign = "center";
  const most = Math.max(1, Math.floor(width / TICK_PX));
  const tick_ns = TICKS_NS.find((ns) => (stamp_ns - first_ns) / ns <= most) ?? TICKS_NS.at(-1);
  for (let ns = Math.ceil(first_ns / tick_ns) * tick_ns; ns < stamp_ns; ns += tick_ns) {
    if (x(ns) < EDGE_PX || x(ns) > width - EDGE_PX) continue;
    context.fillText(ns % DAY_NS ? clock(ns, tick_ns < 60e9) : dayShort(ns), x(ns), height - 1);
  }
  context.fillStyle = ink.alarm;
  for (const change of site.changes) {
    const at = x(change.first_ns);
    context.beginPath();
    context.moveTo(at, 1); context.lineTo(at + 5, 6); context.lineTo(at, 11); context.lineTo(at - 5, 6);
    context.fill();
  }
}
