// Panel: where to send the grader. The stretches of road that cost most, why, since when, and how sure that is.
import { panel } from "../cards/panel.js";
import { kindAt } from "../colours.js";
import { amount, byId, element, note, part, section } from "../elements.js";
import { drawLine, drawPlate, freePlace, stroke, textWidth, trace } from "../map/pen.js";
import { redraw } from "../map/picture.js";
import { fly } from "../map/sight.js";
import { choices, getJson, parameter, site, times, view } from "../state/index.js";
import { day, dayShort, figure, percent } from "../words.js";
import { chart } from "./chart.js";

export const title = "Where to send the grader", everySeconds = 30, wholeSite = true;
const MOST = 10, MOST_CHANGES = 5;
const NEAR_PX = 14; // of a stretch's line, where a click is meant for it
const ROOM_M = 40; // around a stretch that the view flies to
const CLEAR_TREND = 0.001; // of resistance a day: less is not worth a foreman's time
const DAY_NS = 86400e9, CHART_PX = 32;
const LEAST_H = 0.5; // of traffic, for rates per hour: less does not say what an hour costs
const ASIDE_PX = [[0, 0], [0, -22], [0, 22], [24, 0], [-24, 0], [24, -22], [-24, 22]]; // of a stretch: its number
const NO_ROADS = "No roads are known yet. They appear where machines drive over the same ground again.";
const GUESSED = "No machine said what it weighs where a number has a ~: what is lost there is a guess.";
const TIES = "Those that cost nearly the same may stand in either order.";
// target: resistance of good ground. hours: of traffic. lit: the section pointed at, on map and list.
export const work = { target: 0.02, rows: [], changes: [], hours: 0, lit: null };
const small = (text) => element("small", {}, text), bold = (text) => element("b", {}, text);

export async function build(signal) {
  const asked = { target: work.target, limit: MOST, as_of: times.asOf };
  const answer = await getJson(site.path("worklist"), asked, signal);
  Object.assign(work, { hours: answer.hours, rows: answer.rows, changes: answer.changes.slice(0, MOST_CHANGES) });
  return [head(answer), answer.rows.length ? list(answer.rows) : null, work.changes.length ? changed() : null];
}

function head({ rows, total_kwh_ph: total, hours }) {
  const label = { className: "note field" };
  const against = element("label", label, "Target rolling resistance", targetField(), "% of weight");
  if (!rows.length) {
    const none = `No stretch is worse than ${percent(work.target)} beyond doubt. Nothing for the grader to do.`;
    return section(element("p", { className: "say empty" }, hours ? none : NO_ROADS), against);
  }
  const sum = (name) => rows.reduce((all, row) => all + row[name][0], 0), lost = sum("kwh_ph");
  const since = hours < 1.5 ? count(Math.round(60 * hours), "minute") : `${figure(hours)} hours`;
  const short = `From ${since} of traffic. Losses per hour are shown after 30 minutes.`;
  if (isShort()) return section(note(short), against);
  return section(element("div", { className: "totals" },
    amount(figure(lost), "kWh/h", rows.length === 1 ? "lost on this one" : `lost on these ${rows.length}`),
    amount(Math.round(100 * Math.min(1, lost / Math.max(total, 1e-9))), "%", "of all that is lost"),
    amount(figure(sum("litres_ph")), "L/h", "of diesel, about")),
  note(`Calculated from ${since} of traffic.`),
  rows.some((row) => row.segment.guessed) ? element("p", { className: "note guess" }, GUESSED) : null, against);
}

const count = (number, word) => `${number} ${word}${number === 1 ? "" : word === "pass" ? "es" : "s"}`;
const isShort = () => work.hours < LEAST_H;
const isTarget = (target) => target > 0 && target <= 1;

function targetField() {
  const value = (100 * work.target).toFixed(1), limits = { type: "number", min: 0.1, max: 30, step: 0.1 };
  return element("input", { id: "target", ...limits, value, onchange: ({ target: field }) => {
    if (!isTarget(field.value / 100)) return void Object.assign(field, { value });
    work.target = field.value / 100;
    panel.again();
  } });
}

const list = (rows) => element("section", { className: "part stretches" },
  element("h3", { className: "cap" }, "Worst first", isShort() ? "" : bold("kWh lost an hour")),
  element("ol", {}, rows.map((row, i) => element("li", {}, stretch(row, i + 1)))),
  rows.some((row, i) => i && row.rank === rows[i - 1].rank) ? note(TIES) : null);

const burned = ({ predicted_ph: [predicted], burned_ph: [litres] }) =>
  `predicted ${figure(predicted)}, burned ${figure(litres)} L/h`;

function stretch(row, place) {
  const { segment, segment: { id, line, resistance, passes_ph, length_m, trend, guessed } } = row;
  const [kwh, low, high] = row.kwh_ph;
  const costs = `${figure(row.litres_ph[0])} L, ${Math.round(row.seconds_ph[0])} s`;
  const rolls = () => `${percent(resistance)} ${kindAt(resistance, site.boundaries).name}`;
  const passes = passes_ph[0] + passes_ph[1], passed = count(Math.round(passes * work.hours), "pass");
  const change = `${trend > 0 ? "+" : "−"}${percent(Math.abs(trend))}/day`;
  const rate = `${passes.toFixed(passes < 9.95 ? 1 : 0)} passes/h`;
  const driven = `${Math.round(length_m)} m, ${isShort() ? passed : rate}`;
  const className = isShort() ? "stretch early" : "stretch";
  return flier(`stretch-${id}`, className, id, line, element("span", { className: "place" }, `${place}`),
    element("span", {}, bold(resistance === null ? "not measured" : rolls()), small(driven), small(since(row))),
    element("span", { className: "days" }, sparkline(row), Math.abs(trend) < CLEAR_TREND ? null : small(change)),
    isShort() ? null : element("span", { className: "lost" }, bold(`${guessed ? "~" : ""}${figure(kwh)}`),
      small(`${figure(low)} to ${figure(high)}`), small(costs), segment.fuel ? small(burned(segment.fuel)) : null));
}

const when = (ns) => (site.stamp_ns - site.first_ns > 2 * DAY_NS ? dayShort(ns) : times.words(ns));
function since({ since_ns, before }) {
  if (before !== null) return `since ${when(since_ns)}, was ${percent(before)}`;
  return since_ns <= site.first_ns ? "since the first drive" : `since before ${when(since_ns)}`;
}

// A button that flies to a line on the map, and lights it while it is pointed at.
function flier(id, className, name, line, ...children) {
  const box = [[Math.min, -ROOM_M], [Math.max, ROOM_M]].flatMap(([end, room]) =>
    [0, 1].map((axis) => end(...line.map((point) => point[axis])) + room));
  const on = () => light(name), off = () => light(null), onclick = () => { on(); fly(box); };
  const does = { onclick, onpointerenter: on, onpointerleave: off, onfocus: on, onblur: off };
  return element("button", { id, className, title: "Fly there", ...does }, ...children);
}

function light(id) {
  work.lit = id;
  redraw();
}

// Resistance day by day, above a dotted line for the target.
function sparkline({ day_ns: at, day_resistance: values }) {
  const { ink } = choices, { target } = work, last = at.length - 1, most = Math.max(1.25 * target, ...values);
  const y = (value) => 4 + (CHART_PX - 8) * (1 - value / most);
  const on = (i, date) => `${percent(values[i])} on ${date(at[i])}`;
  const one = last < 0 ? "Not measured on any day" : on(0, day);
  const title = last > 0 ? `From ${on(0, dayShort)} to ${on(last, dayShort)}` : one;
  return Object.assign(chart(CHART_PX, title, (context, width) => {
    const x = (ns) => (last ? 4 + (width - 8) * (ns - at[0]) / (at[last] - at[0]) : width - 4);
    trace(context, [[0, y(target)], [width, y(target)]]);
    stroke(context, ink.soft, 1, 1, [2, 3]);
    if (last < 0) return;
    context.lineJoin = "round";
    trace(context, values.map((value, i) => [x(at[i]), y(value)]));
    stroke(context, ink.text, 1.5);
    context.fillStyle = ink.text;
    context.beginPath();
    context.arc(x(at[last]), y(values[last]), 2.5, 0, 2 * Math.PI);
    context.fill();
  }), { title });
}

function changed() {
  const rows = work.changes.map(({ id, line, seen_ns, first_ns, before, after, saved_kwh_ph: saved }) => {
    const cost = `${saved > 0 ? "saves" : "costs"} ${figure(Math.abs(saved))} kWh/h`;
    return element("li", {}, flier(`changed-${id}-${seen_ns}`, "stretch short", id, line,
      element("span", {}, bold(after < before ? "Repaired" : "Became worse"), small(when(first_ns))),
      element("span", { className: "lost" }, bold(`${percent(before)} → ${percent(after)}`),
        small(isShort() || Math.abs(saved) < 0.005 ? "" : cost))));
  });
  return part("Changed lately", "", element("ul", { className: "stretches" }, rows));
}

export function draw(context) {
  const { rows, changes, lit } = work, { ink } = choices;
  const shown = rows.map(({ segment: { id, line } }, i) => ({ id, line, text: `${i + 1}` }));
  const change = shown.some(({ id }) => id === lit) ? undefined : changes.find(({ id }) => id === lit);
  if (change) shown.push({ ...change, text: change.after < change.before ? "repaired" : "worse" });
  shown.sort((a, b) => (a.id === lit) - (b.id === lit)); // what is lit lies on top, and its number has its place first
  const colour = ({ id }) => (id === lit ? ink.alarm : ink.text);
  for (const one of shown) drawLine(context, one.line, colour(one), one.id === lit ? 7 : 4);
  const style = (one) => ({ face: colour(one), colour: ink.surface, halo: ink.halo });
  for (const one of shown.reverse()) drawNumber(context, one, style(one));
}

// It keeps off the others, and off the map where none of its places is free.
function drawNumber(context, { line, text }, style) {
  const width = Math.max(20, textWidth(context, text) + 12), middle = line[Math.floor(line.length / 2)];
  const [x, y] = view.toScreen(...middle);
  const place = freePlace(ASIDE_PX.map(([right, down]) => [x + right, y + down]), width);
  if (place) drawPlate(context, text, place, width, style);
}

// A click on a stretch lights it in the list.
export function pick(_, point) {
  const away = (line) => nearest(point, line.map((place) => view.toScreen(...place)));
  const near = work.rows.map(({ segment: { id, line } }) => [away(line), id]).filter(([pixels]) => pixels < NEAR_PX);
  if (near.length) byId(`stretch-${near.sort((a, b) => a[0] - b[0])[0][1]}`)?.focus();
  return near.length > 0;
}

const nearest = (point, ends) => Math.min(...ends.slice(1).map((end, i) => distance(point, ends[i], end)));
function distance([x, y], [ax, ay], [bx, by]) { // of a point from a piece of a line
  const dx = bx - ax, dy = by - ay, along = ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1);
  const u = Math.min(1, Math.max(0, along));
  return Math.hypot(x - ax - u * dx, y - ay - u * dy);
}

export const link = () => ({ panel: "work", target: work.target });
export function restore() {
  if (parameter("panel") !== "work") return false;
  if (isTarget(Number(parameter("target")))) work.target = Number(parameter("target"));
  return true;
}
