// A layer of the map: machines as arrows with names, where they were, and how well they know where they are.
import { choices, site, times, view } from "../state/index.js";
import { span } from "../words.js";
import { drawPlate, freePlace, keepOff, stroke, textWidth, trace } from "./pen.js";

const TRACK_S = 60, LABEL_CHARS = 40;
const ARROW_PX = 14; // around a machine's arrow: a click there is for the machine, not for the ground
const INSIDE_95 = 2.448; // deviations, of a normal distribution in the plane

const areShown = () => choices.shows.machines && times.at === null;

export function drawMachines(context) {
  if (!areShown()) return;
  for (const machine of site.machines.values()) drawMachine(context, machine);
}

// What is drawn before the machines keeps off their arrows.
export function keepOffMachines() {
  if (areShown()) for (const { x_m, y_m } of site.machines.values()) keepOff(view.toScreen(x_m, y_m), 2 * ARROW_PX);
}

// The machine that is drawn there; undefined for none.
export function machineAt(left, top) {
  if (!areShown()) return undefined;
  const away = ({ x_m, y_m }) => { const [x, y] = view.toScreen(x_m, y_m); return Math.hypot(x - left, y - top); };
  const near = [...site.machines.values()].filter((machine) => away(machine) < ARROW_PX);
  return near.sort((a, b) => away(a) - away(b))[0]?.machine;
}

function drawMachine(context, machine) {
  const { ink } = choices, now_s = performance.now() / 1000, isTrusted = site.trusted[machine.machine] !== false;
  const isSilent = site.isSilent(machine), isGrey = isSilent || !isTrusted;
  const place = view.toScreen(machine.x_m, machine.y_m);
  if (choices.shows.tracks) drawTrack(context, machine.track, now_s, isGrey ? ink.faint : ink.text);
  drawEllipse(context, machine, place, isGrey ? ink.faint : ink.accent, isGrey ? [3, 3] : []);
  drawArrow(context, machine, place, isGrey ? ink.faint : ink.text);
  const fault = machine.faults?.[0] ?? "";
  const state = !isTrusted ? "not used" : isSilent ? `silent ${span(now_s - machine.seen_s)}` : cut(fault);
  drawLabel(context, state ? `${machine.machine} · ${state}` : machine.machine, place, isGrey);
}

const cut = (text) => (text.length > LABEL_CHARS ? `${text.slice(0, LABEL_CHARS - 1)}…` : text);

function drawTrack(context, track, now_s, colour) {
  const points = track.filter((point) => now_s - point.seen_s < TRACK_S);
  context.lineCap = context.lineJoin = "round";
  for (let i = 1; i < points.length; i++) {
    const strength = Math.max(0.08, 1 - (now_s - points[i].seen_s) / TRACK_S);
    trace(context, [points[i - 1], points[i]].map(({ x_m, y_m }) => view.toScreen(x_m, y_m)));
    stroke(context, choices.ink.halo, 3.5, 0.35 * strength);
    stroke(context, colour, 1.75, 0.8 * strength);
  }
}

function drawEllipse(context, { cov_xx_m2: xx, cov_xy_m2: xy, cov_yy_m2: yy }, [x, y], colour, dashes) {
  const half = (xx - yy) / 2, root = Math.hypot(half, xy), mean = (xx + yy) / 2, scale = INSIDE_95 * view.scale;
  const long = scale * Math.sqrt(mean + root), short = scale * Math.sqrt(Math.max(0, mean - root));
  if (long <= 5) return;
  context.beginPath();
  context.ellipse(x, y, long, short, -0.5 * Math.atan2(xy, half), 0, 2 * Math.PI);
  context.fillStyle = colour;
  context.globalAlpha = 0.14;
  context.fill();
  stroke(context, colour, 1.25, 0.9, dashes);
}

function drawArrow(context, machine, [x, y], colour) {
  const size = Math.min(1, Math.max(0.72, view.scale / 3));
  context.save();
  context.translate(x, y);
  context.rotate(-machine.heading_rad);
  context.scale(size, size);
  context.beginPath();
  context.moveTo(11, 0);
  context.lineTo(-7.5, 7.2);
  context.quadraticCurveTo(-4.2, 0, -7.5, -7.2);
  context.closePath();
  context.lineJoin = "round";
  stroke(context, choices.ink.halo, 4.5);
  context.fillStyle = colour;
  context.fill();
  context.restore();
}

// A label is right of where the rail ends, and left of where the window does, if its machine is. It covers no arrow, no
// other label and no number of the panel's; a machine without room for one has none.
function drawLabel(context, text, [left, middle], isGrey) {
  const { ink } = choices, edge = view.margins[0] - 16, width = textWidth(context, text) + 14;
  const isInside = left > edge && left < view.width;
  const x = isInside ? Math.max(edge + width / 2, Math.min(left, view.width - width / 2 - 4)) : left;
  const place = freePlace([-22, 22, -44, 44, -66, 66].map((away) => [x, middle + away]), width);
  const style = { face: ink.surface, colour: isGrey ? ink.soft : ink.text, alpha: 0.94 };
  if (place) drawPlate(context, text, place, width, style);
}
