// Card: the colours of the layer, as a histogram of the site.
import { KINDS, css } from "../colours.js";
import { byId, element, swap, swatch } from "../elements.js";
import { choices, shown, site, times } from "../state/index.js";
import { short } from "../words.js";

const BINS = 48, WIDTH = 400, HEIGHT = 72, BAR_TOP = 52, TALLEST = 46; // of the picture's pixels
const PALETTES = [["ordered", "Ordered"], ["kinds", "Kinds of ground"]];
const EDGE = 0.08; // a tick so close to an end is set against it

export function showLegend() {
  const { map, layer } = shown.map(), differs = layer.id === "difference";
  const { counts, known } = map.histogram(layer, BINS, times.now_ns);
  const palettes = swap("palette", PALETTES, choices.palette, (name) => choices.setPalette(name));
  palettes.hidden = layer.id !== "resistance";
  byId("legend").replaceChildren(heading(layer, differs), histogram(layer, differs, counts),
    element("div", { className: "ticks" }, layer.ticks.map(tick)), !differs && choices.hasKinds ? kinds() : "",
    ...unknown(differs), palettes);
  const area = `${Math.round(known * site.map.cell_m ** 2).toLocaleString("en")} m² known`;
  byId("known").textContent = known ? `${area}${differs ? " at both times" : ""}` : "";
}

function heading({ name, unit }, differs) {
  const span = `${times.words(times.other)} to ${times.words(times.at)}`;
  return element("h2", { className: "cap" }, differs ? "Difference" : name, element("b", {}, differs ? span : unit));
}

function histogram(layer, differs, counts) {
  const ariaLabel = `${layer.name}: how many cells have which value`;
  const strip = element("canvas", { width: WIDTH, height: HEIGHT, role: "img", ariaLabel });
  const colour = differs ? layer.colour : choices.colour(site.boundaries);
  const pen = strip.getContext("2d"), one = WIDTH / BINS, most = Math.max(1, ...counts);
  for (let i = 0; i < BINS; i++) {
    const tall = TALLEST * Math.sqrt(counts[i] / most);
    pen.fillStyle = css(colour(layer.of((i + 0.5) / BINS)));
    pen.fillRect(Math.floor(i * one), BAR_TOP, Math.ceil(one), HEIGHT - BAR_TOP);
    pen.fillRect(i * one + 1, BAR_TOP - 2 - tall, one - 2, tall);
  }
  return strip;
}

const tick = ([at, text]) =>
  element("span", { className: at < EDGE ? "first" : at > 1 - EDGE ? "last" : "", style: `left: ${100 * at}%` }, text);

const kinds = () => element("ul", { className: "kinds" }, KINDS.map(({ name, rgb, value }) =>
  element("li", {}, swatch(css(rgb)), name, element("span", {}, short(value)))));

function unknown(differs) {
  const line = (className, words) => element("p", { className: "unknown" }, element("i", { className }), words);
  if (differs) return [line("", "Unknown at one of the times")];
  return [line("", "Unknown"), line("driven", "Driven, not measured")];
}
