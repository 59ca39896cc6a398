// The link to what is shown: kept in the address, copied, restored.
import { panel } from "./cards/panel.js";
import { fit } from "./map/sight.js";
import { PANELS } from "./panels/index.js";
import { choices, parameter, site, times, view } from "./state/index.js";

const REST_MS = 250; // what is shown stands still for so long before the address follows
let timer = 0;

export function keepLink() {
  clearTimeout(timer);
  timer = setTimeout(() => history.replaceState(null, "", linkOf()), REST_MS);
}

export const copyLink = () => navigator.clipboard?.writeText(location.origin + linkOf());

const iso = (ns) => new Date(ns / 1e6).toISOString();

function linkOf() {
  const { at, other, mode } = times, parts = { site: site.name, layer: choices.layer.id, palette: choices.palette };
  if (view.moved) parts.at = `${view.x.toFixed(1)},${view.y.toFixed(1)},${view.scale.toFixed(2)}`;
  if (at !== null) parts.time = iso(at);
  if (other !== null) Object.assign(parts, { other: iso(other), mode });
  return `${location.pathname}?${new URLSearchParams({ ...parts, ...panel.shown?.link() })}`;
}

// What the link that opened the page says, once there is a map.
let isRestored = false;
export function restoreLink() {
  if (isRestored || site.isEmpty) return;
  isRestored = true;
  const at = parameter("at")?.split(",").map(Number);
  const time = Date.parse(parameter("time")), other = Date.parse(parameter("other"));
  if (at?.length === 3 && at.every(Number.isFinite)) view.look(...at); else fit();
  if (!Number.isNaN(time)) times.go(time * 1e6);
  const mode = parameter("mode") === "difference" ? "difference" : "beside";
  if (!Number.isNaN(other)) times.compareWith(other * 1e6, mode);
  const open = Object.keys(PANELS).find((name) => PANELS[name].restore());
  if (open) panel.open(open);
}
