// Card: the value of the place where a pointer rests.
import { KINDS } from "../colours.js";
import { byId, element } from "../elements.js";
import { choices, getJson, shown, site, times, view } from "../state/index.js";
import { spread } from "../words.js";

const REST_MS = 120; // a pointer that stays so long asks for the value
const WIDTH_PX = 200, ASIDE_PX = 14, ABOVE_PX = 46;
const readout = byId("readout");
let timer = 0;

export function hideReadout() {
  clearTimeout(timer);
  readout.classList.remove("on");
}

export function rest(left, top) {
  clearTimeout(timer);
  timer = setTimeout(() => showValue(left, top).catch(hideReadout), REST_MS);
}

async function showValue(left, top) {
  const { map, at } = shown.at(left), cell = view.toSite(left, top).map((v) => Math.floor(v / site.map.cell_m));
  if (Number.isNaN(map.at(...cell, "visits"))) return hideReadout();
  const { asked: name, std, text } = choices.layer, layers = [name, "resistance_class", ...(std ? [std] : [])].join();
  const [x, y] = cell.map((index) => (index + 0.5) * map.cell_m);
  const ask = async (as_of) => (await getJson(site.path("point"), { x, y, layers, as_of })).values;
  const [values, then] = await Promise.all([ask(at), times.isSubtracted ? ask(times.other) : null]);
  const words = (value) => (value === null ? "not measured" : text(value)), value = values[name];
  const was = then ? `${words(then[name])} → ` : "", kind = KINDS[values.resistance_class];
  const [east, north] = cell.map((index) => `${(index * map.cell_m).toFixed(0)} m`);
  readout.replaceChildren(element("b", {}, was, words(value) + (value === null ? "" : spread(values[std]))),
    element("small", {}, `${kind ? `${kind.name} · ` : ""}${east} E, ${north} N`));
  readout.dataset.value = value ?? "";
  readout.style.left = `${Math.min(innerWidth - WIDTH_PX, left + ASIDE_PX)}px`;
  readout.style.top = `${Math.max(8, top - ABOVE_PX)}px`;
  readout.classList.add("on");
}
