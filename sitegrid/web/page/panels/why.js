// Panel: why a cell has its value.
import { panel } from "../cards/panel.js";
import { KINDS, kindAt } from "../colours.js";
import { element, facts, note, part, say, section, swatch } from "../elements.js";
import { stroke } from "../map/pen.js";
import { Refused, choices, getJson, parameter, site, times, view } from "../state/index.js";
import { ago, clock, percent, spread } from "../words.js";
import { colourOf, courseChart, roseChart, voteChart } from "./evidence_charts.js";

export const title = "Why this value?";
const KILONEWTONS = 20 * 9.81; // weight of a machine of 20 t
const UNKNOWN = "Nobody has driven over this cell. It stays hatched until a machine crosses it.";
const POINTS = ["E", "NE", "N", "NW", "W", "SW", "S", "SE"];
let cell = null; // [column, row]
let isOther = false; // it is of the time that is compared with

// Explain a cell, as of another time than now or the one that is compared with.
export function explain(column, row, at) {
  cell = [column, row];
  isOther = at !== null && at === times.other;
  panel.open("why");
}

export const follow = () => { isOther = false; };

export async function build(signal) {
  const [x, y] = cell.map((index) => (index + 0.5) * site.map.cell_m), as_of = isOther ? times.other : times.asOf;
  const why = await getJson(site.path("why"), { x, y, as_of }, signal);
  const edge = (index) => (index * why.cell_m).toFixed(0);
  const where = note(cell.map((index, i) => `${edge(index)} to ${edge(index + 1)} m ${"EN"[i]}`).join(", "));
  if (!why.metres) return [section(say(UNKNOWN), where)];
  const values = [value(why, where), changed(why), votes(why), counts(why), machines(why)];
  return [...values, await course(x, y, as_of, why, signal)];
}

function value({ values }, where) {
  const { resistance, resistance_std, visits } = values;
  if (resistance === null) {
    return section(say(visits === null ? "Machines only touched this cell: there is too little evidence for a value."
      : "Machines drove here, but none could measure the resistance."), where);
  }
  const kind = element("span", { className: "chip" }, swatch(colourOf(resistance)), nameOf(resistance));
  const std = element("span", {}, spread(resistance_std).trim());
  return section(element("p", { className: "big" }, element("b", {}, percent(resistance)), std, kind),
    say(`Rolling takes ${(resistance * KILONEWTONS).toFixed(1)} kN of a 20 t machine.`), where);
}

const nameOf = (resistance) => kindAt(resistance, site.boundaries).name;

function changed({ changed_ns, before }) {
  if (!changed_ns) return null;
  const { resistance: value } = before, was = value === null ? "" : `Was ${percent(value)} (${nameOf(value)}). `;
  const heading = element("b", {}, `Changed ${clock(changed_ns)}. `);
  return section(element("p", { className: "change" }, heading, `${was}Older votes no longer count.`),
    element("button", { className: "act", onclick: () => times.compareWith(changed_ns) }, "Compare with before"));
}

function votes({ values: { confidence, resistance_class: kind }, resistance }) {
  const leading = confidence === null ? "" : `${percent(confidence, 0)} for ${(KINDS[kind] ?? KINDS.at(-1)).name}`;
  const dashed = resistance.before.some(Boolean) ? note("Dashed: votes before the change") : null;
  return part("Votes", leading, voteChart(resistance), dashed);
}

function counts({ values, stamp_ns, newest_ns, metres, sectors }) {
  const { visits, grade, grade_std: std, grade_east: east, grade_north: north } = values;
  const slope = grade === null ? "unknown" : grade < 0.01 ? "level" : `${percent(grade)} up to ${compass(east, north)}`;
  const rows = facts([
    ["Passes", visits === null ? "not one" : `${Math.round(visits)}`],
    ["Newest", ago(Math.max(0, (stamp_ns - newest_ns) / 1e9))],
    ["Slope", slope],
    std === null || grade === null ? null : ["", `± ${percent(std)}`],
    ["Evidence", `${metres.toFixed(metres < 1 ? 2 : 1)} m driven`],
  ]);
  return element("section", { className: "part two" }, rows, roseChart(sectors));
}

const compass = (east, north) => POINTS.at(Math.round(Math.atan2(north, east) / (Math.PI / 4)) % POINTS.length);

function machines({ machines: names, values }) {
  return part("Machines", `${names.length || Math.round(values.machines ?? 0)}`,
    say(names.length ? names.join(", ") : "Not known by name."));
}

async function course(x, y, to, { changed_ns }, signal) {
  try {
    const { spans } = await getJson(site.path("history"), { x, y, layers: "resistance", to }, signal);
    const known = spans.map(({ values, ...span }) => ({ ...span, value: values.resistance }))
      .filter(({ value }) => value !== null);
    if (known.length < 2) return null;
    return part("Over time", "rolling resistance, % of weight", courseChart(known, changed_ns));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    return part("Over time", "", note(error.message));
  }
}

export function draw(context) {
  const [column, row] = cell, { cell_m } = site.map, side = Math.max(6, cell_m * view.scale);
  context.beginPath();
  context.rect(...view.toScreen(column * cell_m, (row + 1) * cell_m), side, side);
  stroke(context, choices.ink.surface, 4);
  stroke(context, choices.ink.text, 2);
}

export const link = () => ({ cell: cell.join() });
export function restore() {
  const asked = parameter("cell")?.split(",").map(Number);
  if (asked?.length !== 2 || !asked.every(Number.isInteger)) return false;
  cell = asked;
  return true;
}
