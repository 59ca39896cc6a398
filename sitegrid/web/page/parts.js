// Pieces of the page: elements without markup in strings, so that no machine's name becomes markup; small charts.
import { Refused } from "./live.js";
import { KINDS, css, kindOf, ordered, place } from "./palette.js";

export const byId = (id) => document.getElementById(id);

export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return made;
}

export const part = (title, note, ...children) =>
  element("section", { className: "part" }, element("h3", { className: "cap" }, title, element("b", {}, note ?? "")), ...children);

export const facts = (rows) =>
  element("dl", { className: "facts" }, rows.filter(Boolean).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));

// A figure that is an answer, its unit, and a line beneath.
export const amount = (value, unit, note) => element("div", {}, element("b", {}, `${value}`, element("em", {}, ` ${unit}`)), element("span", {}, note));

// One of a few choices; ids are NAME-CHOICE.
export const swap = (name, choices, chosen, choose) =>
  element("div", { className: "swap", role: "group" }, choices.map(([choice, text]) => {
    const button = element("button", { id: `${name}-${choice}`, onclick: () => choose(choice) }, text);
    button.setAttribute("aria-pressed", choice === chosen);
    return button;
  }));

// What could not be read, and why; the page asks again by itself once the server is back.
export function failure(page, error) {
  page.failed = !(error instanceof Refused) || error.status >= 500;
  const text = error instanceof Refused ? error.message : "The page's server does not answer. It is asked again when it is back.";
  return element("section", { className: "part" }, element("p", { className: "say failed", role: "alert" }, text), element("button", { id: "again", className: "act", onclick: () => page.openPanel(page.panel) }, "Try again"));
}

// A chart: a canvas of the given height that `draw(context, width)` fills, again with `redraw`; its figures also stand in `label`.
export function chart(height, label, draw) {
  const canvas = element("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", label);
  canvas.style.height = `${height}px`;
  canvas.redraw = () => {
    const ratio = Math.min(2, devicePixelRatio || 1), width = canvas.clientWidth;
    if (!width) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.font = `11px ${getComputedStyle(document.body).fontFamily}`;
    draw(context, width);
  };
  new ResizeObserver(canvas.redraw).observe(canvas); // also when it is first on the page: only then it has a width
  return canvas;
}

// Votes over the bins of rolling resistance, on the ranges of the kinds of ground; dashed: those before a change.
export function voteChart(why, boundaries, palette, ink) {
  const { centres, votes, before } = why.resistance, most = Math.max(...votes, ...before, 1e-9), height = 104, floor = height - 30;
  const low = Math.log(centres[0]), step = Math.log(centres[1] / centres[0]);
  const leading = votes.indexOf(Math.max(...votes));
  return chart(height, `Most votes are for ${(100 * centres[leading]).toFixed(1)} % of weight`, (context, width) => {
    const one = width / centres.length, x = (value) => (Math.log(value) - low + step / 2) / step * one;
    const edges = [0, ...boundaries.map(x), width];
    for (let i = 0; i + 1 < edges.length; i++) {
      context.fillStyle = i % 2 ? ink.face : ink.hatch;
      context.fillRect(edges[i], 0, edges[i + 1] - edges[i], floor);
    }
    centres.forEach((centre, i) => {
      const tall = (floor - 6) * votes[i] / most, was = (floor - 6) * before[i] / most;
      context.fillStyle = css(palette === "kinds" ? KINDS[Math.min(KINDS.length - 1, kindOf(centre, boundaries))].rgb : ordered(place(centre)));
      if (votes[i]) { context.beginPath(); context.roundRect(i * one + 1, floor - tall, one - 2, tall, [2, 2, 0, 0]); context.fill(); }
      if (before[i]) { context.setLineDash([2, 2]); context.strokeStyle = ink.alarm; context.lineWidth = 1.25; context.strokeRect(i * one + 1.5, floor - was, one - 3, was); context.setLineDash([]); }
    });
    context.fillStyle = ink.soft;
    context.textAlign = "center";
    KINDS.forEach((kind, i) => {
      const at = Math.min(width - 18, Math.max(18, x(kind.value)));
      context.fillText(`${(100 * kind.value).toFixed(kind.value < 0.01 ? 1 : 0)}${i === 2 ? "" : " %"}`, at, floor + 12);
      if (i !== 2) context.fillText(kind.name.split(" ").at(i === 3 ? 0 : -1), at, floor + 24);
    });
  });
}

// Directions that machines drove in, by sectors from east counter-clockwise.
export function roseChart(sectors, ink) {
  const most = Math.max(...sectors, 1e-9);
  const made = chart(84, "Directions that machines drove in", (context, width) => {
    const x = width / 2, y = 46, radius = 32;
    context.strokeStyle = ink.faint;
    context.lineWidth = 0.75;
    for (const part of [0.5, 1]) { context.beginPath(); context.arc(x, y, radius * part, 0, 2 * Math.PI); context.stroke(); }
    context.fillStyle = ink.accent;
    sectors.forEach((metres, i) => {
      const middle = -2 * Math.PI * i / sectors.length, half = Math.PI / sectors.length;
      context.beginPath();
      context.moveTo(x, y);
      context.arc(x, y, radius * Math.sqrt(metres / most), middle - half, middle + half);
      context.fill();
    });
    context.fillStyle = ink.soft;
    context.textAlign = "center";
    context.fillText("N", x, 10);
  });
  return made;
}

// A value over time: spans [{first_ns, last_ns, value}], changes as marks.
export function timeChart(spans, changed_ns, ink) {
  const values = spans.map((span) => span.value), from = spans[0].first_ns, to = spans.at(-1).last_ns;
  const low = Math.min(...values) * 0.9, high = Math.max(...values) * 1.1, height = 74;
  return chart(height, `From ${(100 * values[0]).toFixed(1)} % to ${(100 * values.at(-1)).toFixed(1)} % of weight`, (context, width) => {
    const x = (ns) => 34 + (width - 36) * (ns - from) / Math.max(1, to - from), y = (v) => 6 + (height - 24) * (1 - (v - low) / (high - low));
    context.fillStyle = ink.soft;
    context.strokeStyle = ink.hatch;
    for (const value of [Math.min(...values), Math.max(...values)]) {
      context.beginPath(); context.moveTo(34, y(value)); context.lineTo(width, y(value)); context.stroke();
      context.textAlign = "left";
      context.fillText(`${(100 * value).toFixed(1)} %`, 0, y(value) + 4);
    }
    context.strokeStyle = ink.text;
    context.lineWidth = 1.75;
    context.beginPath();
    spans.forEach((span, i) => { context[i ? "lineTo" : "moveTo"](x(span.first_ns), y(span.value)); context.lineTo(x(span.last_ns), y(span.value)); });
    context.stroke();
    if (changed_ns > from) { context.fillStyle = ink.alarm; context.fillRect(x(changed_ns) - 1, 2, 2, height - 20); }
    context.fillStyle = ink.soft;
    context.fillText(clock(from), 34, height - 2);
    context.textAlign = "right";
    context.fillText(clock(to), width, height - 2);
  });
}

export const clock = (ns, seconds = false) => new Date(ns / 1e6).toISOString().slice(11, seconds ? 19 : 16);
export const dayShort = (ns) => new Date(ns / 1e6).toLocaleDateString("en-GB", { day: "numeric", month: "short", timeZone: "UTC" });
export const day = (ns) => new Date(ns / 1e6).toLocaleDateString("en-GB", { day: "numeric", month: "short", year: "numeric", timeZone: "UTC" });
