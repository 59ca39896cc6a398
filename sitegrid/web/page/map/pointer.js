// Fingers, mouse and wheel on the map: they move it, divide two times, and choose places.
import { panel } from "../cards/panel.js";
import { hideReadout, rest } from "../cards/readout.js";
import { choose as chooseMachine } from "../panels/agents.js";
import { explain } from "../panels/why.js";
import { shown, site, times, view } from "../state/index.js";
import { machineAt } from "./machines.js";
import { canvas } from "./picture.js";
import { uncover } from "./sight.js";

const HOLD_PX = 14; // beside the line between two times, where it can be taken
const CLICK_PX = 4; // what travels less is a click
const pointers = new Map();
let travelled = 0, spread = 0, isHeld = false;

// A place that was chosen: the panel's, a machine, or a cell to explain.
export function choose(left, top) {
  const place = view.toSite(left, top), machine = machineAt(left, top), { at } = shown.at(left);
  if (panel.shown?.pick?.(place, [left, top])) return;
  if (machine) return chooseMachine(machine);
  hideReadout();
  uncover(left, top);
  explain(...place.map((v) => Math.floor(v / site.map.cell_m)), at);
}

export function followPointers() {
  canvas.addEventListener("pointerdown", onDown);
  canvas.addEventListener("pointermove", onMove);
  canvas.addEventListener("pointerup", onUp);
  canvas.addEventListener("pointercancel", onUp);
  canvas.addEventListener("pointerleave", hideReadout);
  canvas.addEventListener("wheel", onWheel, { passive: false });
}

const placeOf = (event) => [event.clientX, event.clientY];
const divides = (left) => times.isBeside && Math.abs(left - innerWidth * times.split) < HOLD_PX;
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
const middle = () => [0, 1].map((axis) => mean([...pointers.values()].map((place) => place[axis])));
function apart() {
  const [a, b] = [...pointers.values()];
  return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
}

function onDown(event) {
  canvas.setPointerCapture(event.pointerId);
  if (!pointers.size) [travelled, isHeld] = [0, divides(event.clientX)];
  pointers.set(event.pointerId, placeOf(event));
  spread = apart();
}

function onMove(event) {
  if (!pointers.has(event.pointerId)) {
    canvas.classList.toggle("divides", divides(event.clientX));
    return rest(...placeOf(event));
  }
  if (!isHeld) return drag(event);
  travelled += CLICK_PX;
  hideReadout();
  times.divide(event.clientX / innerWidth);
}

function drag(event) {
  const before = middle();
  pointers.set(event.pointerId, placeOf(event));
  const after = middle(), right = after[0] - before[0], down = after[1] - before[1];
  travelled += Math.hypot(right, down) + (pointers.size > 1 ? CLICK_PX : 0);
  if (travelled < CLICK_PX) return;
  canvas.classList.add("drag");
  view.shift(right, down);
  if (pointers.size === 2 && spread) view.zoom(apart() / spread, ...after);
  spread = apart();
  hideReadout();
}

function onUp(event) {
  if (!pointers.delete(event.pointerId)) return;
  canvas.classList.remove("drag");
  spread = apart();
  if (!pointers.size && travelled < CLICK_PX && event.type === "pointerup") choose(...placeOf(event));
}

function onWheel(event) {
  event.preventDefault();
  view.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), ...placeOf(event));
}
