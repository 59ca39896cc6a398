// The picture of the site: its layers, from the ground up, drawn whenever something has changed.
import { byId } from "../elements.js";
import { panel } from "../cards/panel.js";
import { showScale } from "../cards/scale.js";
import { showSides } from "../cards/sides.js";
import { site, view } from "../state/index.js";
import { drawBaseMap, drawOutline } from "./base_map.js";
import { drawChanges } from "./changes.js";
import { drawCross } from "./cross.js";
import { drawGround } from "./ground.js";
import { drawMachines, keepOffMachines } from "./machines.js";
import { drawLanes } from "./lanes.js";
import { clearPlates, ratio } from "./pen.js";
import { drawTiles } from "./tiles.js";

export const canvas = byId("map");
const drawPanel = (context) => panel.shown?.draw?.(context);
// Layers, from the ground up: those of cells are drawn pixel by pixel, the others in the page's units.
const LAYERS = [[drawGround, true], [drawBaseMap, true], [drawOutline], [drawTiles, true],
  ...[drawLanes, drawChanges, keepOffMachines, drawPanel, drawMachines, drawCross].map((draw) => [draw])];

let isDirty = true;
export const drawn = { frames: 0 };
export const redraw = () => { isDirty = true; };

export function drawFrames() {
  requestAnimationFrame(drawFrames);
  view.advance();
  if (isDirty || site.machines.size) drawFrame();
}

export function drawFrame() {
  const [width, height] = [innerWidth, innerHeight].map((pixels) => Math.round(pixels * ratio()));
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  view.size(innerWidth, innerHeight);
  isDirty = false;
  clearPlates();
  const context = canvas.getContext("2d", { alpha: false });
  for (const [draw, isPixels] of LAYERS) {
    const scale = isPixels ? 1 : ratio();
    context.setTransform(scale, 0, 0, scale, 0, 0);
    draw(context);
  }
  showSides();
  showScale();
  drawn.frames++;
}
