// A layer of the map: the cross in its middle, once it is moved by keys.
import { choices, view } from "../state/index.js";
import { stroke, trace } from "./pen.js";

let isUsed = false;
export const useCross = () => { isUsed = true; };

export function drawCross(context) {
  if (!isUsed || document.activeElement !== context.canvas) return;
  const x = view.width / 2, y = view.height / 2;
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    trace(context, [[x + 4 * dx, y + 4 * dy], [x + 13 * dx, y + 13 * dy]]);
    stroke(context, choices.ink.halo, 4);
    stroke(context, choices.ink.text, 1.75);
  }
}
