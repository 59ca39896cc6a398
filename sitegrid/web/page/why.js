// Panel: why a cell has its value.
import { drawCell } from "./draw.js";
import { Refused, getJson } from "./live.js";
import { KINDS, ago, css, kindOf, ordered, percent, place } from "./palette.js";
import { chart, clock, element, facts, part, roseChart, timeChart, voteChart } from "./parts.js";

export const title = "Why this value?";

export async function build(page, signal) {
  const [column, row] = page.cell;
  const at = { x: (column + 0.5) * page.map.cell_m, y: (row + 0.5) * page.map.cell_m, as_of: page.asOf() };
  const why = await getJson(page.path("why"), { ...at, repairs: at.as_of ? undefined : 1 }, signal);
  const where = `${(column * why.cell_m).toFixed(0)} to ${((column + 1) * why.cell_m).toFixed(0)} m E, ${(row * why.cell_m).toFixed(0)} to ${((row + 1) * why.cell_m).toFixed(0)} m N`;
  if (!why.metres) {
    return [element("section", { className: "part" }, element("p", { className: "say" }, "Nobody has driven over this cell. It stays hatched until a machine crosses it."), element("p", { className: "note" }, where))];
  }
  return [head(page, why, where), changed(page, why), votes(page, why), counts(page, why), machines(why), await overTime(page, at, why, signal)];
}

function head(page, why, where) {
  const { resistance: value, resistance_std: std } = why.values;
  if (value === null) {
    const text = why.values.visits === null ? "Machines only touched this cell: there is too little evidence for a value." : "Machines drove here, but none could measure the resistance.";
    return element("section", { className: "part" }, element("p", { className: "say" }, text), element("p", { className: "note" }, where));
  }
  const kind = KINDS[Math.min(KINDS.length - 1, kindOf(value, page.boundaries))], colour = page.palette === "kinds" ? kind.rgb : ordered(place(value));
  const swatch = element("i");
  swatch.style.background = css(colour);
  return element("section", { className: "part" },
    element("p", { className: "big" }, element("b", {}, percent(value)), element("span", {}, std === null ? "" : `± ${(100 * std).toFixed(1)}`), element("span", { className: "chip" }, swatch, kind.name)),
    element("p", { className: "say" }, `Rolling takes ${(value * 20 * 9.81).toFixed(1)} kN of a 20 t machine.`),
    element("p", { className: "note" }, where));
}

function changed(page, why) {
  if (!why.changed_ns) return null;
  const was = why.before.resistance;
  const text = was === null ? "Older votes no longer count." : `Was ${percent(was)} (${KINDS[Math.min(KINDS.length - 1, kindOf(was, page.boundaries))].name}). Older votes no longer count.`;
  return element("section", { className: "part" }, element("p", { className: "change" }, element("b", {}, `Changed ${clock(why.changed_ns)}. `), text),
    element("button", { className: "act", onclick: () => page.compareWith(why.changed_ns) }, "Compare with before"));
}

function votes(page, why) {
  const share = why.values.confidence, kind = why.values.resistance_class;
  const note = share === null ? "" : `${percent(share, 0)} for ${KINDS[Math.min(KINDS.length - 1, kind)].name}`;
  return part("Votes", note, voteChart(why, page.boundaries, page.palette, page.ink), why.resistance.before.some(Boolean) ? element("p", { className: "note" }, "Dashed: votes before the change") : null);
}

function counts(page, why) {
  const { visits, grade, grade_std: std, grade_east: east, grade_north: north } = why.values;
  const slope = grade === null ? "unknown" : grade < 0.01 ? "level" : `${percent(grade)} up to ${compass(Math.atan2(north, east))}`;
  const rows = facts([["Passes", visits === null ? "not one" : `${Math.round(visits)}`], ["Newest", ago(Math.max(0, (why.stamp_ns - why.newest_ns) / 1e9))], ["Slope", slope], std === null || grade === null ? null : ["", `± ${percent(std)}`], ["Evidence", `${why.metres.toFixed(why.metres < 1 ? 2 : 1)} m driven`]]);
  return element("section", { className: "part two" }, rows, roseChart(why.sectors, page.ink));
}

const compass = (angle) => ["E", "NE", "N", "NW", "W", "SW", "S", "SE"][Math.round(((angle + 2 * Math.PI) % (2 * Math.PI)) / (Math.PI / 4)) % 8];

function machines(why) {
  return part("Machines", `${why.machines.length || Math.round(why.values.machines ?? 0)}`, element("p", { className: "say" }, why.machines.length ? why.machines.join(", ") : "Not known by name."));
}

async function overTime(page, at, why, signal) {
  try {
    const { spans } = await getJson(page.path("history"), { x: at.x, y: at.y, layers: "resistance", to: at.as_of }, signal);
    const known = spans.filter((span) => span.values.resistance !== null).map((span) => ({ ...span, value: span.values.resistance }));
    if (known.length < 2) return null;
    return part("Over time", "rolling resistance, % of weight", timeChart(known, why.changed_ns, page.ink));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    return part("Over time", "", element("p", { className: "note" }, error.message));
  }
}

export function draw(page, context, view) {
  drawCell(context, view, page.cell, page.map.cell_m, page.ink);
}

export const link = (page) => ({ cell: page.cell.join() });
export function restore(page, parameters) {
  const cell = parameters.get("cell")?.split(",").map(Number), usable = cell?.length === 2 && cell.every(Number.isInteger);
  if (usable) page.cell = cell;
  return usable;
}
