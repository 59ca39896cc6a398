// What the view is to show: the site and its machines, beside the cards, as long as nobody moves it.
import { panel } from "../cards/panel.js";
import { around, site, times, view } from "../state/index.js";

const PANEL_PX = 420, PANEL_PART = 0.62; // of the window's right that the panel covers; of a phone's height
const NEAR_M = 5, ROOM_M = 15; // around a machine: what is in sight, and what is made so where it leaves that
const NOTHING = [-50, -50, 50, 50]; // a box to show where nothing is known
let fitted; // the box that the view was fitted to

export const isPhone = () => innerWidth <= 720;
function margins(besidePanel) {
  if (isPhone()) return [16, 172, 16, besidePanel ? PANEL_PART * innerHeight + 32 : 190];
  return [272, 66, besidePanel ? PANEL_PX : 24, 96];
}

function groundAndMachines(room_m) {
  const machines = [...site.machines.values()];
  const boxes = machines.map(({ x_m: x, y_m: y }) => [x - room_m, y - room_m, x + room_m, y + room_m]);
  return around([site.map.bounds(), ...boxes].filter(Boolean));
}

export function fit() {
  view.size(innerWidth, innerHeight); // before the first picture too
  fitted = groundAndMachines(ROOM_M);
  const outline = around((site.backdrop?.outline ?? []).flat().map(([x, y]) => [x, y, x, y]));
  view.fit(fitted ?? outline ?? NOTHING, margins(panel.shown?.wholeSite));
}

export function fitUnlessMoved() { if (!view.moved) fit(); }

// A map that grows and machines that drive stay in sight, as long as nobody has moved the view.
export function keepInSight() {
  if (view.moved || times.at !== null || site.state === "loading") return;
  const near = groundAndMachines(NEAR_M);
  if (!near) return;
  if (!fitted) return fit();
  if (around([fitted, near]).every((edge, i) => edge === fitted[i])) return;
  fitted = around([fitted, groundAndMachines(ROOM_M)]);
  view.fly(fitted, view.margins, false);
}

// Fly to a box of the site, beside the panel.
export const fly = (box) => view.fly(box, margins(true));

// A place on the screen that the panel would cover goes above or beside it.
export function uncover(left, top) {
  if (isPhone()) view.shift(view.width / 2 - left, view.height * 0.28 - top);
  else if (left > innerWidth - PANEL_PX) view.shift(innerWidth - PANEL_PX - left, 0);
}
