// Panel: where to send the grader. The stretches of road that cost most, why, since when, and how sure that is.
import { drawBadge, drawLine } from "./draw.js";
import { getJson } from "./live.js";
import { KINDS, figure, kindOf, percent } from "./palette.js";
import { amount, chart, day, dayShort, element, part } from "./parts.js";

export const title = "Where to send the grader";
export const everySeconds = 30, wholeSite = true;
export const begin = () => ({ target: 0.02, rows: [], changes: [], lit: null });
const MOST = 10, MOST_CHANGES = 5;
const NEAR_PX = 14; // of a stretch's line, where a click is meant for it
const ROOM_M = 40; // around a stretch that the view flies to
const DAY_NS = 86400e9;
const CLEAR_TREND = 0.001; // of resistance a day: less is not worth a foreman's time

export async function build(page, signal) {
  const { work } = page;
  const answer = await getJson(page.path("worklist"), { target: work.target, limit: MOST, as_of: page.asOf() }, signal);
  work.rows = answer.rows;
  work.changes = answer.changes.slice(0, MOST_CHANGES);
  return [head(page, answer), list(page), changed(page)];
}

function head(page, { rows, total_kwh_ph: total, hours }) {
  const { work } = page, sum = (name) => rows.reduce((all, row) => all + row[name][0], 0), lost = sum("kwh_ph");
  const target = element("input", { id: "target", type: "number", min: 0.1, max: 30, step: 0.1, value: (100 * work.target).toFixed(1), onchange: () => {
    const asked = Number(target.value) / 100;
    if (asked > 0 && asked <= 1) { work.target = asked; page.openPanel("work"); } else target.value = (100 * work.target).toFixed(1);
  } });
  const against = element("label", { className: "note field" }, "Good ground rolls at", target, "% of weight");
  if (!rows.length) {
    const text = hours ? `No stretch is worse than ${percent(work.target)} beyond doubt. Nothing for the grader to do.` : "No roads are known yet. They appear where machines drive over the same ground again.";
    return element("section", { className: "part" }, element("p", { className: "say empty" }, text), against);
  }
  const guessed = rows.some((row) => row.segment.guessed);
  const lead = rows.length === 1 ? "lost on this one" : `lost on these ${rows.length}`;
  return element("section", { className: "part" },
    element("div", { className: "totals" }, amount(figure(lost), "kWh/h", lead), amount(Math.round(100 * Math.min(1, lost / Math.max(total, 1e-9))), "%", "of all that is lost"), amount(figure(sum("litres_ph")), "L/h", "of diesel, about")),
    guessed ? element("p", { className: "note guess" }, "No machine said what it weighs where a number has a ~: what is lost there is a guess.") : null,
    against);
}

function list(page) {
  const { rows } = page.work, ties = rows.some((row, i) => i && row.rank === rows[i - 1].rank);
  if (!rows.length) return null;
  return element("section", { className: "part stretches" },
    element("h3", { className: "cap" }, "Worst first", element("b", {}, "kWh lost an hour")),
    element("ol", {}, rows.map((row, i) => element("li", {}, stretch(page, row, i + 1)))),
    ties ? element("p", { className: "note" }, "Those that cost nearly the same may stand in either order.") : null);
}

function stretch(page, row, place) {
  const { segment } = row, [value, low, high] = row.kwh_ph, passes = segment.passes_ph[0] + segment.passes_ph[1];
  const kind = segment.resistance === null ? "not measured" : `${percent(segment.resistance)} ${KINDS[Math.min(KINDS.length - 1, kindOf(segment.resistance, page.boundaries))].name}`;
  const trend = segment.trend !== null && Math.abs(segment.trend) >= CLEAR_TREND ? `${segment.trend > 0 ? "+" : "−"}${percent(Math.abs(segment.trend))}/day` : null;
  const first = row.since_ns <= page.time.first_ns ? "since the first drive" : `since before ${when(page, row.since_ns)}`;
  const history = row.before === null ? first : `since ${when(page, row.since_ns)}, was ${percent(row.before)}`;
  const reasons = [`${Math.round(segment.length_m)} m, ${passes.toFixed(passes < 9.95 ? 1 : 0)} passes/h`, history];
  return element("button", { id: `stretch-${segment.id}`, className: "stretch", title: "Fly there", onclick: () => { light(page, segment.id); page.fly(around(segment.line)); }, ...lights(page, segment.id) },
    element("span", { className: "place" }, `${place}`),
    element("span", {}, element("b", {}, kind), ...reasons.map((text) => element("small", {}, text))),
    element("span", { className: "days" }, sparkline(page, row.day_ns.map((day_ns, i) => ({ day_ns, resistance: row.day_resistance[i] }))), trend && element("small", {}, trend)),
    element("span", { className: "lost" }, element("b", {}, `${segment.guessed ? "~" : ""}${figure(value)}`), element("small", {}, `${figure(low)} to ${figure(high)}`), element("small", {}, `${figure(row.litres_ph[0])} L, ${Math.round(row.seconds_ph[0])} s`)));
}

const when = (page, ns) => (page.time.last_ns - page.time.first_ns > 2 * DAY_NS ? dayShort(ns) : page.time.words(ns));

// Resistance day by day, above a dotted line for the target.
function sparkline(page, days) {
  const { ink, work: { target } } = page, height = 32, first = days[0]?.day_ns, last = days.at(-1)?.day_ns;
  const words = days.length > 1 ? `From ${percent(days[0].resistance)} on ${dayShort(first)} to ${percent(days.at(-1).resistance)} on ${dayShort(last)}` : days.length ? `${percent(days[0].resistance)} on ${day(first)}` : "Not measured on any day";
  const most = Math.max(1.25 * target, ...days.map((one) => one.resistance));
  const made = chart(height, words, (context, width) => {
    const x = (ns) => (last > first ? 4 + (width - 8) * (ns - first) / (last - first) : width - 4), y = (value) => 4 + (height - 8) * (1 - value / most);
    context.setLineDash([2, 3]);
    context.strokeStyle = ink.soft;
    context.beginPath(); context.moveTo(0, y(target)); context.lineTo(width, y(target)); context.stroke();
    context.setLineDash([]);
    if (!days.length) return;
    context.strokeStyle = context.fillStyle = ink.text;
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    context.beginPath();
    days.forEach((one, i) => context[i ? "lineTo" : "moveTo"](x(one.day_ns), y(one.resistance)));
    context.stroke();
    context.beginPath();
    context.arc(x(last), y(days.at(-1).resistance), 2.5, 0, 2 * Math.PI);
    context.fill();
  });
  made.title = words;
  return made;
}

function changed(page) {
  const { changes } = page.work;
  if (!changes.length) return null;
  return part("Changed lately", "", element("ul", { className: "stretches" }, changes.map((change) => {
    const better = change.after < change.before, saved = change.saved_kwh_ph;
    const effect = Math.abs(saved) < 0.005 ? "" : saved > 0 ? `saves ${figure(saved)} kWh/h` : `costs ${figure(-saved)} kWh/h`;
    return element("li", {}, element("button", { id: `changed-${change.id}-${change.seen_ns}`, className: "stretch short", onclick: () => { light(page, change.id); page.fly(around(change.line)); }, ...lights(page, change.id) },
      element("span", {}, element("b", {}, better ? "Repaired" : "Became worse"), element("small", {}, when(page, change.first_ns))),
      element("span", { className: "lost" }, element("b", {}, `${percent(change.before)} → ${percent(change.after)}`), element("small", {}, effect))));
  })));
}

const lights = (page, id) => ({ onpointerenter: () => light(page, id), onpointerleave: () => light(page, null), onfocus: () => light(page, id), onblur: () => light(page, null) });
function light(page, id) {
  page.work.lit = id;
  page.redraw();
}

const around = (line) => { const x = line.map((point) => point[0]), y = line.map((point) => point[1]); return [Math.min(...x) - ROOM_M, Math.min(...y) - ROOM_M, Math.max(...x) + ROOM_M, Math.max(...y) + ROOM_M]; };

export function draw(page, context, view) {
  const { rows, changes, lit } = page.work, { ink } = page, taken = [];
  const shown = rows.map((row, i) => ({ id: row.segment.id, line: row.segment.line, text: `${i + 1}` }));
  for (const change of changes) if (change.id === lit && !shown.some((one) => one.id === lit)) shown.push({ id: lit, line: change.line, text: change.after < change.before ? "repaired" : "worse" });
  const litLast = [...shown].sort((a, b) => (a.id === lit) - (b.id === lit));
  for (const { id, line } of litLast) drawLine(context, view, line, id === lit ? ink.alarm : ink.text, id === lit ? 7 : 4, ink);
  for (const { id, line, text } of litLast.reverse()) drawBadge(context, view, text, line[Math.floor(line.length / 2)], id === lit ? ink.alarm : ink.text, ink, taken);
}

// A click on a stretch lights it in the list.
export function pick(page, _, [left, top]) {
  const away = ({ segment: { line } }) => Math.min(...line.slice(1).map((end, i) => distance([left, top], page.view.toScreen(...line[i]), page.view.toScreen(...end))));
  const near = page.work.rows.map((row) => [away(row), row.segment.id]).filter(([pixels]) => pixels < NEAR_PX).sort((a, b) => a[0] - b[0])[0];
  if (near) document.getElementById(`stretch-${near[1]}`)?.focus();
  return Boolean(near);
}

function distance([x, y], [ax, ay], [bx, by]) { // of a point from a piece of a line
  const dx = bx - ax, dy = by - ay, u = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - ax - u * dx, y - ay - u * dy);
}

export const link = (page) => ({ panel: "work", target: page.work.target });
export function restore(page, parameters) {
  if (parameters.get("panel") !== "work") return false;
  const target = Number(parameters.get("target"));
  if (target > 0 && target <= 1) page.work.target = target;
  return true;
}
