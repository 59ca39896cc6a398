// The profile of a route: rolling resistance above, gradient below, with their deviations; hatched where nobody drove.
import { percent } from "./palette.js";
import { chart, element } from "./parts.js";

const CAPTION_PX = 18, RESISTANCE_PX = 88, GRADE_PX = 80, AXIS_PX = 18, LEFT_PX = 34;
const GRADE_TOP_PX = CAPTION_PX + RESISTANCE_PX + 8 + CAPTION_PX, HEIGHT = GRADE_TOP_PX + GRADE_PX + AXIS_PX;

// steps: columns of the answer. at(place): called with [x, y] of the step that is pointed at, null for none.
export function profile({ steps }, ink, at) {
  const n = steps.length_m.length, length = steps.distance_m[n - 1], begin = (i) => (i ? steps.distance_m[i - 1] : 0);
  const known = [...steps.unknown.keys()].filter((i) => steps.unknown[i] < 0.5); // deviations of what is hardly known are cut
  const most = 1.15 * Math.max(0.03, ...known.map((i) => steps.resistance[i] + Math.min(steps.resistance_std[i], steps.resistance[i] / 2)));
  const steepest = 1.15 * Math.max(0.03, ...known.map((i) => Math.abs(steps.slope[i]) + Math.min(steps.slope_std[i], 0.03)));
  let chosen = null;
  const said = element("p", { className: "note said" }, "Point at the profile, or use the arrow keys on it.");
  const x = (metres, width) => LEFT_PX + (width - LEFT_PX - 2) * metres / length;
  const made = chart(HEIGHT, "", (context, width) => {
    panel(context, width, CAPTION_PX, RESISTANCE_PX, 0, most, "resistance", "Rolling resistance, % of weight");
    panel(context, width, GRADE_TOP_PX, GRADE_PX, -steepest, steepest, "slope", "Gradient along, %");
    context.fillStyle = ink.soft;
    context.textAlign = "left";
    context.fillText("0", LEFT_PX, HEIGHT - 4);
    context.textAlign = "right";
    context.fillText(metres(length), width, HEIGHT - 4);
    if (chosen === null) return;
    context.fillStyle = ink.accent;
    context.fillRect(x((begin(chosen) + steps.distance_m[chosen]) / 2, width) - 1, 0, 2, HEIGHT - AXIS_PX);
  });

  function panel(context, width, top, height, low, high, name, caption) {
    const y = (value) => top + height * (1 - (value - low) / (high - low)), values = steps[name], deviations = steps[`${name}_std`];
    context.fillStyle = ink.face;
    context.fillRect(LEFT_PX, top, width - LEFT_PX - 2, height);
    context.fillStyle = ink.soft;
    context.textAlign = "left";
    context.fillText(caption, LEFT_PX, top - 6);
    context.textAlign = "right";
    for (const value of low < 0 ? [low / 1.15, 0, high / 1.15] : [0, high / 1.15]) {
      context.fillText(percent(value, Math.abs(value) < 0.0995 && value ? 1 : 0).replace(" %", ""), LEFT_PX - 5, y(value) + 4);
      context.strokeStyle = ink.hatch;
      context.lineWidth = 1;
      context.beginPath(); context.moveTo(LEFT_PX, y(value)); context.lineTo(width - 2, y(value)); context.stroke();
    }
    context.globalAlpha = 0.25; // one deviation to each side
    context.fillStyle = ink.accent;
    for (let i = 0; i < n; i++) {
      if (values[i] === null || deviations[i] === null || steps.unknown[i] >= 0.5) continue;
      const up = y(Math.min(high, values[i] + deviations[i])), down = y(Math.max(low, values[i] - deviations[i]));
      context.fillRect(x(begin(i), width), up, x(steps.distance_m[i], width) - x(begin(i), width), Math.max(1, down - up));
    }
    context.globalAlpha = 1;
    hatched(context, width, top, height);
    context.strokeStyle = ink.text;
    context.lineWidth = 1.75;
    context.lineJoin = "round";
    context.beginPath();
    let drawn = false;
    for (let i = 0; i < n; i++) {
      if (values[i] === null || steps.unknown[i] >= 0.5) { drawn = false; continue; }
      context[drawn ? "lineTo" : "moveTo"](x(begin(i), width), y(values[i]));
      context.lineTo(x(steps.distance_m[i], width), y(values[i]));
      drawn = true;
    }
    context.stroke();
  }

  function hatched(context, width, top, height) {
    context.save();
    context.beginPath();
    for (let i = 0; i < n; i++) if (steps.unknown[i] >= 0.5) context.rect(x(begin(i), width), top, x(steps.distance_m[i], width) - x(begin(i), width) + 0.5, height);
    context.clip();
    context.strokeStyle = ink.faint;
    context.lineWidth = 1;
    context.beginPath();
    for (let left = LEFT_PX - height; left < width; left += 7) { context.moveTo(left, top + height); context.lineTo(left + height, top); }
    context.stroke();
    context.restore();
  }

  const tell = (i) => {
    chosen = i === null ? null : Math.min(n - 1, Math.max(0, i));
    if (chosen !== null) {
      const unknown = steps.unknown[chosen] >= 0.5, spread = (name) => (steps[`${name}_std`][chosen] === null ? "" : ` ± ${(100 * steps[`${name}_std`][chosen]).toFixed(1)}`);
      const slope = steps.slope[chosen], leads = Math.abs(slope) < 0.0005 ? "level" : `${slope > 0 ? "up" : "down"} ${(100 * Math.abs(slope)).toFixed(1)}${spread("slope")} %`;
      const ground = unknown ? `nobody drove here, taken as ${percent(steps.resistance[chosen])}` : `${(100 * steps.resistance[chosen]).toFixed(1)}${spread("resistance")} %, ${leads}`;
      said.textContent = `At ${metres(begin(chosen))}: ${ground}, ${Math.round(3.6 * steps.speed_mps[chosen])} km/h`;
    }
    made.setAttribute("aria-valuenow", chosen ?? 0);
    made.setAttribute("aria-valuetext", said.textContent);
    made.redraw();
    at(chosen === null ? null : [steps.x_m[chosen], steps.y_m[chosen]]);
  };
  for (const [name, value] of [["id", "profile"], ["role", "slider"], ["tabindex", 0], ["aria-label", "Profile: rolling resistance and gradient along the route"], ["aria-valuemin", 0], ["aria-valuemax", n - 1], ["aria-valuenow", 0], ["aria-valuetext", said.textContent]]) made.setAttribute(name, value);
  const pointed = (event) => { const box = made.getBoundingClientRect(), u = (event.clientX - box.left - LEFT_PX) / (box.width - LEFT_PX - 2), way = Math.min(1, Math.max(0, u)) * length; tell(steps.distance_m.findIndex((end) => end >= way - 1e-9)); };
  made.addEventListener("pointermove", pointed);
  made.addEventListener("pointerdown", pointed);
  made.addEventListener("pointerleave", () => { if (document.activeElement !== made) tell(null); });
  made.addEventListener("blur", () => tell(null));
  made.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1, ArrowDown: -1, ArrowUp: 1, PageDown: -10, PageUp: 10, Home: -n, End: n }[event.key];
    if (!by) return;
    event.preventDefault();
    event.stopPropagation();
    tell((chosen ?? (by > 0 ? -1 : n)) + by);
  });
  return [made, said];
}

export const metres = (value) => (value >= 1000 ? `${(value / 1000).toFixed(2)} km` : `${Math.round(value)} m`);
