// A layer of the map: lanes, by which machines find their place: in each cell a stroke the way most drive there.
import { choices, getJson, site, times, view } from "../state/index.js";
import { stroke } from "./pen.js";

const EVERY_MS = 60_000, LENGTH_M = 0.45, STRONG_M = 6; // between two questions; half a stroke; driven, for full colour
const STEPS = 4; // of strength
let lanes = null, asked_ms = -EVERY_MS;

export function drawLanes(context) {
  if (!choices.shows.lanes || times.at !== null) return;
  if (performance.now() - asked_ms > EVERY_MS) ask();
  if (lanes) for (let step = 1; step <= STEPS; step++) drawStrokes(context, step);
}

async function ask() {
  asked_ms = performance.now();
  lanes = await getJson(site.path("lanes")).catch(() => lanes); // without a map server the last ones stay
}

function drawStrokes(context, step) {
  const { x_m, y_m, heading_rad, metres } = lanes;
  context.beginPath();
  metres.forEach((driven, i) => {
    if (Math.max(1, Math.ceil((Math.min(driven, STRONG_M) / STRONG_M) * STEPS)) !== step) return;
    const [x, y] = view.toScreen(x_m[i], y_m[i]), long = LENGTH_M * view.scale;
    const right = long * Math.cos(heading_rad[i]), up = long * Math.sin(heading_rad[i]);
    context.moveTo(x - right, y + up);
    context.lineTo(x + right, y - up);
  });
  stroke(context, choices.ink.text, Math.min(2, Math.max(0.75, view.scale / 4)), 0.4 + (0.6 * step) / STEPS);
}
