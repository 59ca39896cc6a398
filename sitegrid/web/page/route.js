// Panel: what a drive costs a machine, along a line of places or along the one between two places that costs least.
import { drawLine, drawPlace } from "./draw.js";
import { getJson } from "./live.js";
import { figure } from "./palette.js";
import { amount, element, failure, part, swap } from "./parts.js";
import { metres, profile } from "./profile.js";

export const title = "What a drive costs";
export const wholeSite = true;
export const begin = () => ({ cheapest: false, cost: "energy", places: [], machine: "truck", mass_t: null, answer: null, at: null });
const MACHINES = [["truck", "Truck, loaded", 47], ["empty_truck", "Truck, empty", 22], ["loader", "Wheel loader, loaded", 22.5]]; // names and tonnes as in the map server's queries
const MOST_PLACES = 100, MOST_T = 1000;
const STEPS = 120; // of a profile: about two pixels each
const FARTHEST_M = 1e6; // of a place in a link

export async function build(page, signal) {
  const { route } = page;
  route.answer = route.at = null;
  page.redraw();
  if (route.places.length < 2) return [choices(page), hint(page)];
  try {
    const answer = await ask(page, signal), straight = route.cheapest ? await askStraight(page, signal) : null;
    route.answer = answer;
    const at = (place) => { route.at = place; page.redraw(); };
    return [choices(page), totals(page, answer, straight), part("Along the way", "hatched: unknown", ...profile(answer, page.ink, at),
      element("p", { className: "note" }, `About ${figure(answer.totals.litres)} L of diesel. Ranges hold 90 %. Slipping wheels take more: 1 to 4 % on firm ground, 10 % in sand.`)), doings(page)];
  } catch (error) {
    if (signal.aborted) throw error;
    return [choices(page), failure(page, error), doings(page)];
  }
}

// The straight line between the ends: unknown ground has the same price on both.
async function askStraight(page, signal) {
  try {
    return (await ask(page, signal, true)).totals;
  } catch (error) {
    if (signal.aborted) throw error;
    return null; // as where a machine cannot climb it
  }
}

function ask(page, signal, straight = false) {
  const { route } = page, [from, to] = [route.places[0], route.places.at(-1)].map((place) => place.join());
  const length = route.places.slice(1).reduce((sum, place, i) => sum + Math.hypot(place[0] - route.places[i][0], place[1] - route.places[i][1]), 0);
  const same = { machine: route.machine, mass: route.mass_t === null ? null : 1000 * route.mass_t, step: Math.max(2, Math.ceil(length / STEPS)), as_of: page.asOf() };
  if (straight) return getJson(page.path("route"), { line: `${from};${to}`, ...same }, signal);
  if (route.cheapest) return getJson(page.path("way"), { from, to, cost: route.cost, ...same }, signal);
  return getJson(page.path("route"), { line: route.places.map((place) => place.join()).join(";"), ...same }, signal);
}

const again = (page, changes) => { Object.assign(page.route, changes); page.openPanel("route"); };

function choices(page) {
  const { route } = page, usual = MACHINES.find(([name]) => name === route.machine)?.[2];
  const machine = element("select", { id: "machine", onchange: () => again(page, { machine: machine.value, mass_t: null }) }, MACHINES.map(([name, words]) => element("option", { value: name, selected: name === route.machine }, words)));
  const mass = element("input", { id: "mass", type: "number", min: 0.1, max: MOST_T, step: 0.1, value: route.mass_t ?? usual ?? "", onchange: () => {
    const asked = Number(mass.value);
    if (asked > 0 && asked <= MOST_T) again(page, { mass_t: asked }); else mass.value = route.mass_t ?? usual ?? "";
  } });
  const ends = () => (route.places.length > 2 ? [route.places[0], route.places.at(-1)] : route.places);
  return element("section", { className: "part choices" },
    swap("drive", [["line", "A line"], ["cheapest", "Cheapest way"]], route.cheapest ? "cheapest" : "line", (name) => again(page, name === "line" ? { cheapest: false } : { cheapest: true, places: ends() })),
    route.cheapest ? swap("cost", [["energy", "Least energy"], ["time", "Least time"]], route.cost, (cost) => again(page, { cost })) : null,
    element("div", { className: "field" }, element("label", { htmlFor: "machine" }, "Machine"), machine, mass, element("label", { htmlFor: "mass" }, "t")));
}

function hint(page) {
  const { places, cheapest } = page.route;
  const first = cheapest ? "Click where it begins, then where it ends." : "Click two places or more on the map: the line that a machine drives.";
  const second = cheapest ? "Now click where it ends." : "Now click the next place.";
  return element("section", { className: "part" }, element("p", { className: "say" }, places.length ? second : first),
    element("p", { className: "note" }, "By keyboard: move the map with the arrows, Enter sets a place at the cross, Backspace takes the last one back."));
}

const kwh = (joules) => figure(joules / 3.6e6);
export const clock = (seconds) => { const whole = Math.round(seconds), minutes = Math.floor(whole / 60); return minutes < 60 ? `${minutes}:${String(whole % 60).padStart(2, "0")}` : `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}:${String(whole % 60).padStart(2, "0")}`; };

function totals(page, { totals: all }, straight) {
  const lift = Math.abs(all.lift_m) < 0.05 ? "level" : `${all.lift_m > 0 ? "up" : "down"} ${Math.abs(all.lift_m).toFixed(1)} m`;
  return element("section", { className: "part" },
    element("div", { className: "totals" },
      amount(kwh(all.energy_j), "kWh", `${kwh(all.energy_low_j)} to ${kwh(all.energy_high_j)}`),
      amount(clock(all.time_s), all.time_s < 3600 ? "min" : "h", `${clock(all.time_low_s)} to ${clock(all.time_high_s)}`),
      amount(metres(all.length_m), "", lift)),
    straight ? element("p", { className: "say compare" }, compared(page, all, straight)) : null,
    all.unknown > 0.005 ? element("p", { className: "change unsure" }, element("b", {}, `${Math.max(1, Math.round(100 * all.unknown))} % unknown. `), `Nobody drove there: taken as ${(100 * all.unknown_resistance).toFixed(1)} %, as dear as the dearest tenth of the ground around.`) : null);
}

function compared(page, all, straight) {
  const name = page.route.cost === "time" ? "time_s" : "energy_j", share = straight[name] / all[name] - 1;
  const percents = Math.round(100 * Math.abs(share)), cost = name === "time_s" ? `${clock(straight.time_s)} min` : `${kwh(straight.energy_j)} kWh`;
  const unknown = straight.unknown > 0.005 ? `, with ${Math.max(1, Math.round(100 * straight.unknown))} % of it unknown` : "";
  return percents ? `The straight line would cost ${cost}, ${percents} % ${share > 0 ? "more" : "less"}${unknown}.` : `The straight line costs the same${unknown}.`;
}

function doings(page) {
  const { route } = page, button = (id, text, act) => element("button", { id, className: "act", onclick: act }, text);
  return element("section", { className: "part row" },
    button("turn", "The other way", () => again(page, { places: [...route.places].reverse() })),
    button("undo", "Take back", () => press(page, "Backspace")),
    button("clear", "Clear", () => again(page, { places: [] })));
}

export function draw(page, context, view) {
  const { places, answer, cheapest, at } = page.route, { ink } = page;
  if (cheapest && places.length > 1) drawLine(context, view, places, ink.soft, 1.5, ink, [5, 5]);
  const line = answer?.line ?? (cheapest ? [] : places);
  if (line.length > 1) drawLine(context, view, line, ink.accent, 4, ink);
  if (answer) drawUnknown(context, view, answer, ink);
  places.forEach((place, i) => drawPlace(context, view, place, i === 0 ? "A" : i === places.length - 1 ? "B" : "", ink));
  if (at) drawPlace(context, view, at, "", ink, true);
}

function drawUnknown(context, view, { line, steps: { x_m: x, y_m: y, unknown } }, ink) {
  const places = [...x.map((value, i) => [value, y[i]]), line.at(-1)];
  unknown.forEach((share, i) => { if (share >= 0.5) drawLine(context, view, [places[i], places[i + 1]], ink.surface, 2, null); });
}

export function pick(page, place) {
  const { route } = page, next = place.map((value) => Number(value.toFixed(1))), last = route.places.at(-1);
  if (last && last[0] === next[0] && last[1] === next[1]) return true; // a second click on the same place
  if (!route.cheapest && route.places.length >= MOST_PLACES) { page.say("A line ends here", `It has ${MOST_PLACES} places already; programs may ask for 10 000.`); return true; }
  again(page, { places: route.cheapest && route.places.length === 2 ? [next] : [...route.places, next] });
  return true;
}

export function press(page, key) {
  if (key !== "Backspace" || !page.route.places.length) return false;
  again(page, { places: page.route.places.slice(0, -1) });
  return true;
}

export function link(page) {
  const { places, cheapest, cost, machine, mass_t: mass } = page.route;
  return { panel: "route", line: places.map((place) => place.join()).join(";"), machine, ...(mass === null ? {} : { mass: 1000 * mass }), ...(cheapest ? { cost } : {}) };
}

export function restore(page, parameters) {
  if (parameters.get("panel") !== "route") return false;
  const { route } = page, text = parameters.get("line") ?? "", mass = Number(parameters.get("mass")) / 1000, machine = parameters.get("machine");
  const places = text ? text.split(";").map((place) => place.split(",").map(Number)) : [];
  const usable = places.length <= MOST_PLACES && places.every((place) => place.length === 2 && place.every((value) => Number.isFinite(value) && Math.abs(value) < FARTHEST_M));
  if (usable) route.places = places; else page.say("The line of this link cannot be read", "Draw it anew on the map.");
  if (MACHINES.some(([name]) => name === machine)) route.machine = machine;
  if (mass > 0 && mass <= MOST_T) route.mass_t = mass;
  if (["energy", "time"].includes(parameters.get("cost"))) Object.assign(route, { cheapest: true, cost: parameters.get("cost"), places: route.places.slice(0, 2) });
  return true;
}
