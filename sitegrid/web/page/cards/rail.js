// Card: what the map can show, and what is shown.
import { byId, element } from "../elements.js";
import { LAYERS } from "../layers.js";
import { choices, site } from "../state/index.js";

export const SHOWS = [["machines", "Machines", "M"], ["tracks", "Tracks, last minute", "T"],
  ["changes", "Changed ground", "G"], ["lanes", "Lanes", "N"], ["base", "Base map", "P"],
  ["unsure", "Fade uncertain", "U"], ["old", "Fade old", "O"]];

export function buildRail() {
  byId("layers").append(...LAYERS.map((layer) =>
    choice("radio", "layer", layer.name, layer.key, () => choices.setLayer(layer))));
  byId("shows").append(...SHOWS.map(([name, text, key]) =>
    choice("checkbox", name, text, key, (on) => choices.setShow(name, on))));
  byId("drawer").onclick = () => byId("drawer").setAttribute("aria-expanded", byId("rail").classList.toggle("full"));
}

function choice(type, name, text, key, set) {
  const input = element("input", { type, name, onchange: (event) => set(event.target.checked) });
  input.dataset.key = key;
  return element("label", { className: `choice ${type}` }, input, element("i", { ariaHidden: true }),
    element("span", {}, text), element("kbd", {}, key));
}

export function showRail() {
  document.getElementsByName("layer")[LAYERS.indexOf(choices.layer)].checked = true;
  byId("drawer").textContent = choices.layer.name;
  for (const [name] of SHOWS) document.getElementsByName(name)[0].checked = choices.shows[name];
  document.getElementsByName("base")[0].parentElement.hidden = !site.backdrop?.base_map;
}
