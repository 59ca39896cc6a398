// What people choose to see: layer, palette, what is drawn, light or dark.
import { kindAt } from "../colours.js";
import { LAYERS } from "../layers.js";
import { Owner, keep, kept, parameter } from "./owner.js";

const INKS = ["ground", "face", "hatch", "text", "soft", "faint", "accent", "halo", "driven", "alarm", "surface",
  "beneath"];
const root = document.documentElement;

// Tells of "layer" (or palette), "shows", "theme" and "paper".
class Choices extends Owner {
  #chosen = LAYERS.find((layer) => layer.id === parameter("layer"));
  layer = this.#chosen ?? LAYERS[0];
  palette = parameter("palette") ?? "ordered";
  shows = { machines: true, tracks: true, changes: true, lanes: false, base: true, unsure: true, old: false };
  ink = {}; // the style sheet's colours, for what is drawn

  get hasKinds() { return this.palette === "kinds" && this.layer.id === "resistance"; }

  // The colour of a value of the layer.
  colour(boundaries) { return this.hasKinds ? (v) => kindAt(v, boundaries).rgb : this.layer.colour; }

  setLayer(layer) { this.become("layer", { layer: this.#chosen = layer }); }
  setPalette(palette) { this.become("layer", { palette }); }
  setShow(name, on = !this.shows[name]) { this.become("shows", { shows: { ...this.shows, [name]: on } }); }

  // Until somebody chooses, the first layer that the map knows anything of.
  suit(map) {
    const layer = this.#chosen ?? LAYERS.find(({ plane }) => map.knows(plane)) ?? this.layer;
    if (layer !== this.layer) this.become("layer", { layer });
  }

  begin() {
    const usual = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    this.#setTheme(parameter("theme") ?? kept("theme") ?? usual);
  }

  toggleTheme() {
    this.#setTheme(root.dataset.theme === "dark" ? "light" : "dark");
    keep("theme", root.dataset.theme);
  }

  // On paper: light, whatever the screen is. Returns what puts the screen's back.
  printed() {
    const { theme } = root.dataset;
    this.#setTheme("light", "paper");
    return () => this.#setTheme(theme, "paper");
  }

  #setTheme(theme, what = "theme") {
    root.dataset.theme = theme;
    const style = getComputedStyle(root), inks = INKS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]);
    this.become(what, { ink: Object.fromEntries(inks) });
  }
}

export const choices = new Choices();
