// What several layers and panels draw with: lines with a halo, words on plates that keep off each other, places.
import { choices, view } from "../state/index.js";

const PLATE_PX = 20, APART_PX = 21; // height of a plate; of the middles of two that stand above each other

export const plates = []; // of this picture, and arrows: {x, y, width}

export const ratio = () => Math.min(2, devicePixelRatio || 1); // pixels of a canvas in one of the page's

// A canvas made anew so large; its context is in the page's pixels.
export function sized(canvas, width, height) {
  Object.assign(canvas, { width: width * ratio(), height: height * ratio() });
  const context = canvas.getContext("2d");
  context.scale(ratio(), ratio());
  return context;
}

export const font = (context, style) => { context.font = `${style} ${getComputedStyle(document.body).fontFamily}`; };

// A path through points in pixels.
export function trace(context, points) {
  context.beginPath();
  for (const [x, y] of points) context.lineTo(x, y);
}

export function stroke(context, colour, width, alpha = 1, dashes = []) {
  context.setLineDash(dashes);
  context.globalAlpha = alpha;
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.stroke();
  context.globalAlpha = 1;
  context.setLineDash([]);
}

// A line on the site, with a halo unless it lies on another; dashes in pixels.
export function drawLine(context, line, colour, width, { halo = true, dashes = [] } = {}) {
  context.lineCap = context.lineJoin = "round";
  trace(context, line.map((place) => view.toScreen(...place)));
  if (halo) stroke(context, choices.ink.halo, width + 3, 0.9);
  stroke(context, colour, width, 1, dashes);
}

// A place of a line, with its name; what is pointed at is a dot.
export function drawPlace(context, place, name, pointed = false) {
  const [x, y] = view.toScreen(...place), { ink } = choices;
  context.beginPath();
  context.arc(x, y, pointed ? 6 : name ? 10 : 5, 0, 2 * Math.PI);
  stroke(context, ink.halo, 4, 0.9);
  context.fillStyle = pointed ? ink.alarm : name ? ink.accent : ink.surface;
  context.fill();
  if (!pointed && !name) stroke(context, ink.accent, 2.5);
  if (!name) return;
  keepOff([x, y], PLATE_PX);
  write(context, name, x, y, ink.surface);
}

function write(context, text, x, y, colour) {
  font(context, "600 12px");
  context.fillStyle = colour;
  context.textAlign = "center";
  context.fillText(text, x, y + 4.2);
}

export function textWidth(context, text) {
  font(context, "600 12px");
  return context.measureText(text).width;
}

export const clearPlates = () => { plates.length = 0; };
export const keepOff = ([x, y], width) => plates.push({ x, y, width });

// The first of places [x, y] where a plate of that width keeps off those of the picture, and off the cards at the top;
// undefined where none does.
export const freePlace = (places, width) =>
  places.find(([x, y]) => y > view.margins[1] - 6 && plates.every((other) =>
    Math.abs(y - other.y) > APART_PX || Math.abs(x - other.x) > (width + other.width) / 2 + 1));

// Words on a plate.
export function drawPlate(context, text, [x, y], width, { face, colour, halo = null, alpha = 1 }) {
  keepOff([x, y], width);
  context.beginPath();
  context.roundRect(x - width / 2, y - PLATE_PX / 2, width, PLATE_PX, 6);
  if (halo) stroke(context, halo, 2, 0.9);
  context.globalAlpha = alpha;
  context.fillStyle = face;
  context.fill();
  context.globalAlpha = 1;
  write(context, text, x, y, colour);
}
