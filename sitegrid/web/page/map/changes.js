// A layer of the map: outlines of changed ground.
import { choices, site, times, view } from "../state/index.js";
import { stroke } from "./pen.js";

const ROOM_M = 2, ROUND_PX = 14;

export function drawChanges(context) {
  if (!choices.shows.changes) return;
  for (const { bounds: [west, south, east, north], first_ns } of site.changes) {
    if (first_ns > times.now_ns) continue;
    const [left, top] = view.toScreen(west - ROOM_M, north + ROOM_M);
    const width = (east - west + 2 * ROOM_M) * view.scale, height = (north - south + 2 * ROOM_M) * view.scale;
    context.beginPath();
    context.roundRect(left, top, width, height, Math.min(ROUND_PX, width / 2, height / 2));
    stroke(context, choices.ink.halo, 4, 0.7);
    stroke(context, choices.ink.alarm, 1.75, 1, [6, 4]);
  }
}
