// Keys of the page, and the list of them.
import { panel } from "./cards/panel.js";
import { SHOWS } from "./cards/rail.js";
import { byId, element, facts } from "./elements.js";
import { LAYERS } from "./layers.js";
import { useCross } from "./map/cross.js";
import { canvas, redraw } from "./map/picture.js";
import { choose } from "./map/pointer.js";
import { fit } from "./map/sight.js";
import { choices, times, view } from "./state/index.js";

const HELP = [
  ["1 to 5", "Layer"], ["M T G N P U O", "Show and hide"], ["Arrows, + −", "Move, zoom"], ["0", "Fit the site"],
  ["W, R, A", "Where to send the grader, what a drive costs, how machines do"],
  ["Enter", "Explain the cell at the cross"], ["Space, [ ]", "Play, step in time"], ["L", "Back to now"],
  ["C", "Compare two times"], ["D", "Light or dark"], ["Esc", "Close"],
];
const MOVES = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
const closer = () => view.zoom(1.4), farther = () => view.zoom(1 / 1.4);
const DOES = {
  "+": closer, "=": closer, "-": farther, "−": farther, "0": fit, "[": () => times.step(-1), "]": () => times.step(1),
  L: () => times.goLive(), C: () => times.nextMode(), W: () => panel.toggle("work"), R: () => panel.toggle("route"),
  A: () => panel.toggle("agents"), D: () => choices.toggleTheme(), "?": showHelp,
};
for (const layer of LAYERS) DOES[layer.key] = () => choices.setLayer(layer);
for (const [name, , key] of SHOWS) DOES[key] = () => choices.setShow(name);

export function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(select|textarea)$/i.test(event.target.tagName)) return;
  const act = actOf(event.key.length === 1 ? event.key.toUpperCase() : event.key, event.target);
  if (!act) return;
  act();
  event.preventDefault();
}

// What a key does; undefined where it is the browser's, or the field's that has it.
function actOf(key, { type, tagName }) {
  const onMap = document.activeElement === canvas;
  const isPressed = tagName === "BUTTON" || ["checkbox", "radio", "range"].includes(type);
  if (key === "Escape") return panel.name ? () => panel.close() : undefined;
  if (type === "number") return undefined;
  if (key in MOVES && onMap) return () => { useCross(); view.shift(...MOVES[key]); };
  if (panel.shown?.press?.(key)) return redraw;
  if (key === "Enter" && onMap) return () => choose(view.width / 2, view.height / 2);
  if (key === " ") return isPressed ? undefined : () => times.play();
  return DOES[key];
}

export function showHelp() {
  const dialog = byId("help"), close = element("button", { className: "act", onclick: () => dialog.close() }, "Close");
  dialog.replaceChildren(element("h2", {}, "Keys"), facts(HELP), close);
  dialog.showModal();
}
