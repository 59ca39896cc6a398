// Card: buttons for panels, the view, the link, light or dark, and keys.
import { byId } from "../elements.js";
import { showHelp } from "../keys.js";
import { copyLink } from "../link.js";
import { fit } from "../map/sight.js";
import { choices } from "../state/index.js";
import { panel } from "./panel.js";

const PANELS = ["agents", "work", "route"], DONE_MS = 900;

export function buildTools() {
  for (const name of PANELS) byId(`open-${name}`).onclick = () => panel.toggle(name);
  const does = { fit, theme: () => choices.toggleTheme(), keys: showHelp, link };
  for (const [name, act] of Object.entries(does)) byId(name).onclick = act;
}

async function link() {
  await copyLink();
  byId("link").classList.add("done");
  setTimeout(() => byId("link").classList.remove("done"), DONE_MS);
}

export function showTools() {
  for (const name of PANELS) byId(`open-${name}`).setAttribute("aria-pressed", panel.name === name);
}
