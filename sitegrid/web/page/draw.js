// Everything on the map that is not a tile: ground, plan, machines, changed areas, cross, scale.
import { span } from "./palette.js";

const SILENT_S = 8, TRACK_S = 60, LABEL_CHARS = 40;

export function inkOf(element) {
  const style = getComputedStyle(element);
  return Object.fromEntries(["ground", "face", "hatch", "text", "soft", "faint", "accent", "halo", "driven", "alarm", "surface"].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

let hatch = { key: "", pattern: null };
export function drawGround(context, ratio, ink) {
  const key = `${ink.face}${ink.hatch}${ratio}`;
  if (hatch.key !== key) {
    const side = Math.round(8 * ratio), canvas = Object.assign(document.createElement("canvas"), { width: side, height: side });
    const pen = canvas.getContext("2d");
    pen.fillStyle = ink.face;
    pen.fillRect(0, 0, side, side);
    pen.strokeStyle = ink.hatch;
    pen.lineWidth = ratio;
    for (const from of [-side, 0, side]) { pen.beginPath(); pen.moveTo(from - 1, side + 1); pen.lineTo(from + side + 1, -1); pen.stroke(); }
    hatch = { key, pattern: context.createPattern(canvas, "repeat") };
  }
  context.fillStyle = hatch.pattern;
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
}

// A picture of the site: pixel (column, row) lies at a*column + b*row + c, d*column + e*row + f (a world file's lines).
export function drawPlan(context, view, plan) {
  const [a, d, b, e, c, f] = plan.world, [left, top] = view.toScreen(c - a / 2 - b / 2, f - d / 2 - e / 2), s = view.scale;
  context.save();
  context.globalAlpha = 0.55;
  context.transform(a * s, -d * s, b * s, -e * s, left, top);
  context.drawImage(plan.image, 0, 0);
  context.restore();
}

export function drawChanges(context, view, changes, ink) {
  for (const change of changes) {
    const [west, south, east, north] = change.bounds, grow = 2;
    const [left, top] = view.toScreen(west - grow, north + grow), [right, bottom] = view.toScreen(east + grow, south - grow);
    context.beginPath();
    context.roundRect(left, top, right - left, bottom - top, Math.min(14, (right - left) / 2, (bottom - top) / 2));
    stroke(context, ink.halo, 4, 0.7);
    context.setLineDash([6, 4]);
    stroke(context, ink.alarm, 1.75);
    context.setLineDash([]);
  }
}

// labels: rectangles of those that are drawn already; a label keeps off them.
export function drawMachine(context, view, machine, now_s, shows, ink, labels) {
  const silent = now_s - machine.seen_s > SILENT_S, grey = silent || machine.trusted === false;
  const [x, y] = view.toScreen(machine.x_m, machine.y_m);
  if (shows.tracks) drawTrack(context, view, machine, now_s, grey ? ink.faint : ink.text, ink);
  const { cov_xx_m2: xx, cov_xy_m2: xy, cov_yy_m2: yy } = machine, half = (xx - yy) / 2, root = Math.hypot(half, xy), mean = (xx + yy) / 2;
  const scale = 2.448 * view.scale; // 95 % of a normal distribution in the plane
  const long = scale * Math.sqrt(mean + root), short = scale * Math.sqrt(Math.max(0, mean - root));
  if (long > 5) {
    context.beginPath();
    context.ellipse(x, y, long, short, -0.5 * Math.atan2(xy, half), 0, 2 * Math.PI);
    context.fillStyle = grey ? ink.faint : ink.accent;
    context.globalAlpha = 0.14;
    context.fill();
    context.setLineDash(grey ? [3, 3] : []);
    stroke(context, grey ? ink.faint : ink.accent, 1.25, 0.9);
    context.setLineDash([]);
  }
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
  stroke(context, ink.halo, 4.5);
  context.fillStyle = grey ? ink.faint : ink.text;
  context.fill();
  context.restore();
  const state = machine.trusted === false ? " · not used" : silent ? ` · silent ${span(now_s - machine.seen_s)}` : hindered(machine.faults?.[0]);
  drawLabel(context, machine.machine + state, x, y, ink, grey, labels, view.margins[0] - 16);
}

// What hinders a machine most, as far as a label has room for it.
const hindered = (fault) => (fault ? ` · ${fault.length > LABEL_CHARS ? `${fault.slice(0, LABEL_CHARS - 1)}…` : fault}` : "");

function drawTrack(context, view, machine, now_s, colour, ink) {
  const points = machine.track.filter((point) => now_s - point.seen_s < TRACK_S);
  context.lineCap = context.lineJoin = "round";
  for (let i = 1; i < points.length; i++) {
    const strength = Math.max(0.08, 1 - (now_s - points[i].seen_s) / TRACK_S);
    context.beginPath();
    context.moveTo(...view.toScreen(points[i - 1].x_m, points[i - 1].y_m));
    context.lineTo(...view.toScreen(points[i].x_m, points[i].y_m));
    stroke(context, ink.halo, 3.5, 0.35 * strength);
    stroke(context, colour, 1.75, 0.8 * strength);
  }
}

// A label stays right of `edge`, where the rail ends, if its machine is.
function drawLabel(context, text, place, middle, ink, grey, labels, edge) {
  context.font = `600 12px ${getComputedStyle(document.body).fontFamily}`;
  const width = context.measureText(text).width + 14, x = place > edge ? Math.max(place, edge + width / 2) : place;
  const free = (at) => labels.every((other) => Math.abs(at - other.y) > 21 || Math.abs(x - other.x) > (width + other.width) / 2);
  const y = [-20, 22, -42, 44, -64].map((away) => middle + away).find(free) ?? middle - 20;
  labels.push({ x, y, width });
  context.globalAlpha = 0.94;
  context.fillStyle = ink.surface;
  context.beginPath();
  context.roundRect(x - width / 2, y - 10, width, 20, 6);
  context.fill();
  context.globalAlpha = 1;
  context.fillStyle = grey ? ink.soft : ink.text;
  context.textAlign = "center";
  context.fillText(text, x, y + 4.2);
}

// The cell that the panel explains, and the cross that the keyboard moves.
export function drawCell(context, view, [column, row], cell_m, ink) {
  const [left, top] = view.toScreen(column * cell_m, (row + 1) * cell_m), side = Math.max(6, cell_m * view.scale);
  context.beginPath();
  context.rect(left, top, side, side);
  stroke(context, ink.surface, 4);
  stroke(context, ink.text, 2);
}

// A line on the site, with a halo unless `ink` is null; dashes in pixels.
export function drawLine(context, view, line, colour, width, ink, dashes = []) {
  context.lineCap = context.lineJoin = "round";
  context.beginPath();
  line.forEach((point, i) => context[i ? "lineTo" : "moveTo"](...view.toScreen(...point)));
  if (ink) stroke(context, ink.halo, width + 3, 0.9);
  context.setLineDash(dashes);
  stroke(context, colour, width);
  context.setLineDash([]);
}

// A word on a place; it keeps off the rectangles in `taken`, and off the map where none of its places is free.
export function drawBadge(context, view, text, place, colour, ink, taken) {
  context.font = `600 12px ${getComputedStyle(document.body).fontFamily}`;
  const width = Math.max(20, context.measureText(text).width + 12), [left, top] = view.toScreen(...place);
  const free = ([right, down]) => taken.every((other) => Math.abs(top + down - other.y) > 21 || Math.abs(left + right - other.x) > (width + other.width) / 2 + 1);
  const by = [[0, 0], [0, -22], [0, 22], [24, 0], [-24, 0], [24, -22], [-24, 22]].find(free);
  if (!by) return;
  const [x, y] = [left + by[0], top + by[1]];
  taken.push({ x, y, width });
  context.beginPath();
  context.roundRect(x - width / 2, y - 10, width, 20, 6);
  stroke(context, ink.halo, 2, 0.9);
  context.fillStyle = colour;
  context.fill();
  context.fillStyle = ink.surface;
  context.textAlign = "center";
  context.fillText(text, x, y + 4.2);
}

// A place of a line, with its name; what is pointed at is a dot.
export function drawPlace(context, view, place, name, ink, pointed = false) {
  const [x, y] = view.toScreen(...place);
  context.beginPath();
  context.arc(x, y, pointed ? 6 : name ? 10 : 5, 0, 2 * Math.PI);
  stroke(context, ink.halo, 4, 0.9);
  context.fillStyle = pointed ? ink.alarm : name ? ink.accent : ink.surface;
  context.fill();
  if (!pointed && !name) stroke(context, ink.accent, 2.5);
  if (!name) return;
  context.font = `600 12px ${getComputedStyle(document.body).fontFamily}`;
  context.fillStyle = ink.surface;
  context.textAlign = "center";
  context.fillText(name, x, y + 4.2);
}

export function drawCross(context, view, ink) {
  const x = view.width / 2, y = view.height / 2;
  context.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { context.moveTo(x + 4 * dx, y + 4 * dy); context.lineTo(x + 13 * dx, y + 13 * dy); }
  stroke(context, ink.halo, 4);
  stroke(context, ink.text, 1.75);
}

export function roundLength(scale, most) {
  for (let power = 4; power >= 0; power--) for (const digit of [5, 2, 1]) if (digit * 10 ** power * scale <= most) return digit * 10 ** power;
  return 1;
}

function stroke(context, colour, width, alpha = 1) {
  context.globalAlpha = alpha;
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.stroke();
  context.globalAlpha = 1;
}
