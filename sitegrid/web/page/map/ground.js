// The lowest layer of the map: hatched ground, which nobody knows.
import { choices } from "../state/index.js";
import { ratio } from "./pen.js";

const HATCH_PX = 8;
let made = { key: "", pattern: null };

export function drawGround(context) {
  const { face, hatch } = choices.ink, key = `${face}${hatch}${ratio()}`;
  if (made.key !== key) made = { key, pattern: context.createPattern(hatched(face, hatch), "repeat") };
  context.fillStyle = made.pattern;
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
}

function hatched(face, hatch) {
  const side = Math.round(HATCH_PX * ratio());
  const canvas = Object.assign(document.createElement("canvas"), { width: side, height: side });
  const pen = canvas.getContext("2d");
  pen.fillStyle = face;
  pen.fillRect(0, 0, side, side);
  pen.strokeStyle = hatch;
  pen.lineWidth = ratio();
  for (const from of [-side, 0, side]) {
    pen.beginPath(); pen.moveTo(from - 1, side + 1); pen.lineTo(from + side + 1, -1); pen.stroke();
  }
  return canvas;
}
