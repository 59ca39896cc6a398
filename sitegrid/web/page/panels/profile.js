// The profile of a route: rolling resistance above, gradient below, with their deviations; hatched where nobody drove.
import { note } from "../elements.js";
import { stroke, trace } from "../map/pen.js";
import { choices } from "../state/index.js";
import { metres, percent, spread } from "../words.js";
import { chart, write } from "./chart.js";

const CAPTION_PX = 18, RESISTANCE_PX = 88, GRADE_PX = 80, AXIS_PX = 18, LEFT_PX = 34;
const GRADE_TOP_PX = CAPTION_PX + RESISTANCE_PX + 8 + CAPTION_PX, HEIGHT = GRADE_TOP_PX + GRADE_PX + AXIS_PX;
const LEAST = 0.03, ROOM = 1.15; // of a panel's range: so much at least, and so much more than its values
const BY = { ArrowLeft: -1, ArrowRight: 1, ArrowDown: -1, ArrowUp: 1, PageDown: -10, PageUp: 10,
  Home: -Infinity, End: Infinity };
const HINT = "Point at the profile, or use the arrow keys on it.";
const NAME = "Profile: rolling resistance and gradient along the route";

// answer: with `steps` as columns. point(place): called with [x, y] of the step that is pointed at, null for none.
export function profile({ steps }, point) {
  const last = steps.length_m.length - 1, said = note(HINT);
  let chosen = null;
  const made = chart(HEIGHT, NAME, (context, width) => drawProfile(context, width, steps, chosen));
  said.classList.add("said");
  Object.assign(made, { id: "profile", role: "slider", tabIndex: 0, ariaValueMin: 0, ariaValueMax: last });
  const tell = (i) => {
    chosen = i === null ? null : Math.min(last, Math.max(0, i));
    if (chosen !== null) said.textContent = words(steps, chosen);
    Object.assign(made, { ariaValueNow: chosen ?? 0, ariaValueText: said.textContent });
    made.redraw();
    point(chosen === null ? null : [steps.x_m[chosen], steps.y_m[chosen]]);
  };
  const pointed = ({ clientX }) => {
    const { left, width } = made.getBoundingClientRect(), u = (clientX - left - LEFT_PX) / (width - LEFT_PX - 2);
    const way_m = Math.min(1, Math.max(0, u)) * steps.distance_m[last];
    tell(steps.distance_m.findIndex((end_m) => end_m >= way_m - 1e-9));
  };
  Object.assign(made, { ariaValueNow: 0, ariaValueText: HINT, onpointermove: pointed, onpointerdown: pointed });
  made.onpointerleave = () => { if (document.activeElement !== made) tell(null); };
  made.onblur = () => tell(null);
  made.onkeydown = (event) => {
    if (!(event.key in BY)) return;
    event.preventDefault();
    event.stopPropagation();
    tell((chosen ?? (BY[event.key] > 0 ? -1 : last + 1)) + BY[event.key]);
  };
  return [made, said];
}

const isUnknown = (steps, i) => steps.unknown[i] >= 0.5;
const beginOf = (steps, i) => (i ? steps.distance_m[i - 1] : 0);

function words(steps, i) {
  const at = `At ${metres(beginOf(steps, i))}`, speed = `${Math.round(3.6 * steps.speed_mps[i])} km/h`;
  const slope = steps.slope[i], resistance = steps.resistance[i];
  const figures = (value, std) => `${(100 * value).toFixed(1)}${spread(std)} %`;
  if (isUnknown(steps, i)) return `${at}: nobody drove here, taken as ${percent(resistance)}, ${speed}`;
  const leads = `${slope > 0 ? "up" : "down"} ${figures(Math.abs(slope), steps.slope_std[i])}`;
  const rolls = figures(resistance, steps.resistance_std[i]);
  return `${at}: ${rolls}, ${Math.abs(slope) < 0.0005 ? "level" : leads}, ${speed}`;
}

function drawProfile(context, width, steps, chosen) {
  const known = [...steps.unknown.keys()].filter((i) => !isUnknown(steps, i)), length = steps.distance_m.at(-1);
  const x = (way_m) => LEFT_PX + (width - LEFT_PX - 2) * way_m / length;
  const pieces = [...steps.unknown.keys()].map((i) => [x(beginOf(steps, i)), x(steps.distance_m[i])]);
  const most = (value, deviation) => ROOM * Math.max(LEAST, ...known.map((i) => value(i) + deviation(i)));
  const rolls = most((i) => steps.resistance[i], (i) => Math.min(steps.resistance_std[i], steps.resistance[i] / 2));
  const steepest = most((i) => Math.abs(steps.slope[i]), (i) => Math.min(steps.slope_std[i], LEAST));
  const { ink } = choices, box = { context, width, steps, pieces };
  drawPanel(box, "resistance", "Rolling resistance, % of weight", CAPTION_PX, RESISTANCE_PX, 0, rolls);
  drawPanel(box, "slope", "Gradient along, %", GRADE_TOP_PX, GRADE_PX, -steepest, steepest);
  context.fillStyle = ink.soft;
  write(context, "0", LEFT_PX, HEIGHT - 4, "left");
  write(context, metres(length), width, HEIGHT - 4, "right");
  if (chosen === null) return;
  context.fillStyle = ink.accent;
  context.fillRect((pieces[chosen][0] + pieces[chosen][1]) / 2 - 1, 0, 2, HEIGHT - AXIS_PX);
}

function drawPanel({ context, width, steps, pieces }, name, caption, top, height, low, high) {
  const y = (value) => top + height * (1 - (value - low) / (high - low)), { ink } = choices;
  const values = steps[name].map((value, i) => (isUnknown(steps, i) ? null : value)), deviations = steps[`${name}_std`];
  context.fillStyle = ink.face;
  context.fillRect(LEFT_PX, top, width - LEFT_PX - 2, height);
  context.fillStyle = ink.soft;
  write(context, caption, LEFT_PX, top - 6, "left");
  for (const value of low < 0 ? [low / ROOM, 0, high / ROOM] : [0, high / ROOM]) {
    const text = percent(value, Math.abs(value) < 0.0995 && value ? 1 : 0).replace(" %", "");
    write(context, text, LEFT_PX - 5, y(value) + 4, "right");
    trace(context, [[LEFT_PX, y(value)], [width - 2, y(value)]]);
    stroke(context, ink.hatch, 1);
  }
  context.globalAlpha = 0.25; // one deviation to each side
  context.fillStyle = ink.accent;
  pieces.forEach(([left, right], i) => {
    if (values[i] === null || deviations[i] === null) return;
    const up = y(Math.min(high, values[i] + deviations[i])), down = y(Math.max(low, values[i] - deviations[i]));
    context.fillRect(left, up, right - left, Math.max(1, down - up));
  });
  context.globalAlpha = 1;
  hatch(context, pieces.filter((_, i) => isUnknown(steps, i)), width, top, height);
  drawValues(context, pieces, values, y);
}

function drawValues(context, pieces, values, y) {
  context.lineJoin = "round";
  context.beginPath();
  pieces.forEach(([left, right], i) => {
    if (values[i] === null) return;
    if (i === 0 || values[i - 1] === null) context.moveTo(left, y(values[i]));
    context.lineTo(left, y(values[i]));
    context.lineTo(right, y(values[i]));
  });
  stroke(context, choices.ink.text, 1.75);
}

function hatch(context, pieces, width, top, height) {
  context.save();
  context.beginPath();
  for (const [left, right] of pieces) context.rect(left, top, right - left + 0.5, height);
  context.clip();
  for (let left = LEFT_PX - height; left < width; left += 7) {
    trace(context, [[left, top + height], [left + height, top]]);
    stroke(context, choices.ink.faint, 1);
  }
  context.restore();
}
