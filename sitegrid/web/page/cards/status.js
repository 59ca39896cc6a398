// Card: the name of the site, others to choose, and how it is.
import { byId, element } from "../elements.js";
import { site, times } from "../state/index.js";

const TROUBLES = { away: "No map server", offline: "Not connected", refused: "No permission" };

export function showSites() {
  const { name, names } = site, option = (value) => element("option", { value, selected: value === name }, value);
  document.title = `${name} · sitegrid`;
  byId("site").textContent = name;
  byId("sites").hidden = names.length < 2;
  byId("choose-site").replaceChildren(...names.map(option));
  byId("choose-site").onchange = (event) => { location.search = new URLSearchParams({ site: event.target.value }); };
}

export function showStatus() {
  const status = byId("status"), { state } = site, isNow = times.at === null;
  status.lastElementChild.textContent = TROUBLES[state] ?? (state === "loading" ? "Loading" : words(isNow));
  status.className = state in TROUBLES ? "bad" : state === "live" && isNow ? "" : "off";
}

function words(isNow) {
  if (!isNow) return `The map as of ${times.words(times.at)}`;
  const machines = [...site.machines.values()], silent = machines.filter((machine) => site.isSilent(machine)).length;
  return `Live, ${machines.length} machine${machines.length === 1 ? "" : "s"}${silent ? `, ${silent} silent` : ""}`;
}
