// Panel: what a drive costs a machine, along a line of places or along the one between two places that costs least.
import { panel } from "../cards/panel.js";
import { say as announce } from "../cards/notice.js";
import { amount, element, note, part, say, section, swap } from "../elements.js";
import { drawLine, drawPlace } from "../map/pen.js";
import { redraw } from "../map/picture.js";
import { choices, getJson, parameter, site, times } from "../state/index.js";
import { duration, figure, metres, percent } from "../words.js";
import { profile } from "./profile.js";

export const title = "What a drive costs", wholeSite = true;
const MACHINES = [["truck", "Truck, loaded", 47], ["empty_truck", "Truck, empty", 22],
  ["loader", "Wheel loader, loaded", 22.5]]; // names and tonnes as in the map server's queries
const DRIVES = [["line", "A line"], ["cheapest", "Cheapest way"]];
const HINTS = {
  line: ["Click two places or more on the map: the line that a machine drives.", "Now click the next place."],
  cheapest: ["Click where it begins, then where it ends.", "Now click where it ends."],
};
const COSTS = [["energy", "Least energy"], ["time", "Least time"]];
const MOST_PLACES = 100, MOST_T = 1000;
const STEPS = 120; // of a profile: about two pixels each
const FARTHEST_M = 1e6; // of a place in a link
const KEYS = "By keyboard: move the map with the arrows, "
  + "Enter sets a place at the cross, Backspace takes the last one back.";
const DEAR = "assumed as bad as the worst tenth of the ground nearby.";
const TERMS = "Ranges hold 90 %. Slipping wheels take more: 1 to 4 % on firm ground, 10 % in sand.";
// mass_t: null for the machine's usual one. at: the place that is pointed at in the profile.
export const route =
  { cheapest: false, cost: "energy", places: [], machine: "truck", mass_t: null, answer: null, at: null };

function become(changes) {
  Object.assign(route, changes);
  redraw();
}

function again(changes) {
  become(changes);
  panel.open("route");
}

export async function build(signal) {
  become({ answer: null, at: null });
  if (route.places.length < 2) return [settings(), hint()];
  try {
    const answer = await ask(signal), straight = route.cheapest ? await askStraight(signal) : null;
    become({ answer });
    const litres = note(`About ${figure(answer.totals.litres)} L of diesel. ${TERMS}`);
    const line = profile(answer, (at) => become({ at }));
    return [settings(), totals(answer, straight), part("Along the way", "hatched: unknown", ...line, litres), doings()];
  } catch (error) {
    if (signal.aborted) throw error;
    return [settings(), panel.failure(error), doings()];
  }
}

const text = (places) => places.map((place) => place.join()).join(";");

function ask(signal) {
  const [from, to] = route.places.map((place) => place.join());
  if (route.cheapest) return getJson(site.path("way"), { from, to, cost: route.cost, ...terms() }, signal);
  return getJson(site.path("route"), { line: text(route.places), ...terms() }, signal);
}

// The straight line between the ends: unknown ground has the same price on both.
async function askStraight(signal) {
  try {
    return (await getJson(site.path("route"), { line: text(route.places), ...terms() }, signal)).totals;
  } catch (error) {
    if (signal.aborted) throw error;
    return null; // as where a machine cannot climb it
  }
}

function terms() {
  const { machine, mass_t, places } = route, mass = mass_t === null ? null : 1000 * mass_t;
  const pieces = places.slice(1).map(([x, y], i) => Math.hypot(x - places[i][0], y - places[i][1]));
  const length_m = pieces.reduce((sum, piece) => sum + piece, 0);
  return { machine, mass, step: Math.max(2, Math.ceil(length_m / STEPS)), as_of: times.asOf };
}

function settings() {
  const { cheapest, cost, places } = route;
  const ends = places.length > 2 ? [places[0], places.at(-1)] : places;
  const drive = (name) => again(name === "line" ? { cheapest: false } : { cheapest: true, places: ends });
  return element("section", { className: "part choices" },
    swap("drive", DRIVES, cheapest ? "cheapest" : "line", drive),
    cheapest ? swap("cost", COSTS, cost, (name) => again({ cost: name })) : null,
    element("div", { className: "field" }, element("label", { htmlFor: "machine" }, "Machine"), machineField(),
      massField(), element("label", { htmlFor: "mass" }, "t")));
}

function machineField() {
  const option = ([value, words]) => element("option", { value, selected: value === route.machine }, words);
  const onchange = ({ target }) => again({ machine: target.value, mass_t: null });
  return element("select", { id: "machine", onchange }, MACHINES.map(option));
}

const isMass = (mass_t) => mass_t > 0 && mass_t <= MOST_T;
function massField() {
  const value = route.mass_t ?? MACHINES.find(([name]) => name === route.machine)?.[2] ?? "";
  const limits = { type: "number", min: 0.1, max: MOST_T, step: 0.1 };
  return element("input", { id: "mass", ...limits, value, onchange: ({ target: field }) => {
    if (isMass(Number(field.value))) again({ mass_t: Number(field.value) }); else Object.assign(field, { value });
  } });
}

function hint() {
  const [first, second] = HINTS[route.cheapest ? "cheapest" : "line"];
  return section(say(route.places.length ? second : first), note(KEYS));
}

const kwh = (joules) => figure(joules / 3.6e6);
const whole = (share) => `${Math.max(1, Math.round(100 * share))} %`;
const isPartlyUnknown = ({ unknown }) => unknown > 0.005;

function totals({ totals: all }, straight) {
  const lift = `${all.lift_m > 0 ? "up" : "down"} ${Math.abs(all.lift_m).toFixed(1)} m`;
  const price = ` Nobody drove there: taken as ${percent(all.unknown_resistance)}, ${DEAR}`;
  return section(
    element("div", { className: "totals" },
      amount(kwh(all.energy_j), "kWh", `${kwh(all.energy_low_j)} to ${kwh(all.energy_high_j)}`),
      amount(duration(all.time_s), all.time_s < 3600 ? "min" : "h",
        `${duration(all.time_low_s)} to ${duration(all.time_high_s)}`),
      amount(metres(all.length_m), "", Math.abs(all.lift_m) < 0.05 ? "level" : lift)),
    straight ? element("p", { className: "say compare" }, compared(all, straight)) : null,
    isPartlyUnknown(all) ? element("p", { className: "change unsure" },
      element("b", {}, `${whole(all.unknown)} unknown.`), price) : null);
}

function compared(all, straight) {
  const name = route.cost === "time" ? "time_s" : "energy_j", share = straight[name] / all[name] - 1;
  const cost = route.cost === "time" ? `${duration(straight.time_s)} min` : `${kwh(straight.energy_j)} kWh`;
  const percents = Math.round(100 * Math.abs(share)), differs = `${percents} % ${share > 0 ? "more" : "less"}`;
  const unknown = isPartlyUnknown(straight) ? `, with ${whole(straight.unknown)} of it unknown` : "";
  return `The straight line ${percents ? `would cost ${cost}, ${differs}` : "costs the same"}${unknown}.`;
}

function doings() {
  const button = (id, words, onclick) => element("button", { id, className: "act", onclick }, words);
  return element("section", { className: "part row" },
    button("turn", "The other way", () => again({ places: [...route.places].reverse() })),
    button("undo", "Take back", () => press("Backspace")),
    button("clear", "Clear", () => again({ places: [] })));
}

export function draw(context) {
  const { places, answer, cheapest, at } = route, { ink } = choices, line = answer?.line ?? (cheapest ? [] : places);
  if (cheapest && places.length > 1) drawLine(context, places, ink.soft, 1.5, { dashes: [5, 5] });
  if (line.length > 1) drawLine(context, line, ink.accent, 4);
  if (answer) drawUnknown(context, answer);
  places.forEach((place, i) => drawPlace(context, place, i === 0 ? "A" : i === places.length - 1 ? "B" : ""));
  if (at) drawPlace(context, at, "", true);
}

function drawUnknown(context, { line, steps: { x_m: x, y_m: y, unknown } }) {
  const places = [...x.map((value, i) => [value, y[i]]), line.at(-1)];
  unknown.forEach((share, i) => {
    if (share >= 0.5) drawLine(context, [places[i], places[i + 1]], choices.ink.surface, 2, { halo: false });
  });
}

export function pick(place) {
  const { places, cheapest } = route, next = place.map((value) => Number(value.toFixed(1)));
  if (places.at(-1)?.join() === next.join()) return true; // a second click on the same place
  if (!cheapest && places.length >= MOST_PLACES) {
    announce("A line ends here", `It has ${MOST_PLACES} places already; programs may ask for 10 000.`);
  } else again({ places: cheapest && places.length === 2 ? [next] : [...places, next] });
  return true;
}

export function press(key) {
  if (key !== "Backspace" || !route.places.length) return false;
  again({ places: route.places.slice(0, -1) });
  return true;
}

export function link() {
  const { places, cheapest, cost, machine, mass_t } = route, mass = mass_t === null ? {} : { mass: 1000 * mass_t };
  return { panel: "route", line: text(places), machine, ...mass, ...(cheapest ? { cost } : {}) };
}

const isPlace = (place) => place.length === 2 && place.every((value) => Math.abs(value) < FARTHEST_M);

export function restore() {
  if (parameter("panel") !== "route") return false;
  const line = parameter("line"), places = line ? line.split(";").map((place) => place.split(",").map(Number)) : [];
  const machine = parameter("machine"), mass_t = Number(parameter("mass")) / 1000, cost = parameter("cost");
  if (places.length <= MOST_PLACES && places.every(isPlace)) route.places = places;
  else announce("The line of this link cannot be read", "Draw it anew on the map.");
  if (MACHINES.some(([name]) => name === machine)) route.machine = machine;
  if (isMass(mass_t)) route.mass_t = mass_t;
  const isCheapest = COSTS.some(([name]) => name === cost);
  if (isCheapest) Object.assign(route, { cheapest: true, cost, places: route.places.slice(0, 2) });
  return true;
}
