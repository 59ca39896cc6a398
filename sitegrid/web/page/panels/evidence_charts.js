// Charts of what a cell's value rests on: votes, directions, its course.
import { KINDS, css, kindAt } from "../colours.js";
import { LAYERS } from "../layers.js";
import { stroke, trace } from "../map/pen.js";
import { choices, site } from "../state/index.js";
import { clock, percent, short } from "../words.js";
import { chart, write } from "./chart.js";

const VOTES_PX = 104, ROSE_PX = 84, COURSE_PX = 74, LEFT_PX = 34, LINE_PX = 12;

// A colour of rolling resistance, whatever layer is shown.
export const colourOf = (value) =>
  css(choices.palette === "kinds" ? kindAt(value, site.boundaries).rgb : LAYERS[0].colour(value));

// Votes over the bins of rolling resistance, on the ranges of the kinds of ground; dashed: those before a change.
export function voteChart({ centres, votes, before }) {
  const most = Math.max(...votes, ...before, 1e-9), floor = VOTES_PX - 30, { ink } = choices;
  const low = Math.log(centres[0]), step = Math.log(centres[1] / centres[0]);
  const leading = votes.indexOf(Math.max(...votes));
  return chart(VOTES_PX, `Most votes are for ${percent(centres[leading])} of weight`, (context, width) => {
    const one = width / centres.length, x = (value) => (Math.log(value) - low + step / 2) / step * one;
    const edges = [0, ...site.boundaries.map(x), width];
    for (let i = 0; i + 1 < edges.length; i++) {
      context.fillStyle = i % 2 ? ink.face : ink.hatch;
      context.fillRect(edges[i], 0, edges[i + 1] - edges[i], floor);
    }
    centres.forEach((centre, i) => {
      const tall = (floor - 6) * votes[i] / most, was = (floor - 6) * before[i] / most;
      context.fillStyle = colourOf(centre);
      context.beginPath();
      if (votes[i]) context.roundRect(i * one + 1, floor - tall, one - 2, tall, [2, 2, 0, 0]);
      context.fill();
      context.beginPath();
      if (before[i]) context.rect(i * one + 1.5, floor - was, one - 3, was);
      stroke(context, ink.alarm, 1.25, 1, [2, 2]);
    });
    context.fillStyle = ink.soft;
    KINDS.forEach((kind, i) => { // the third has no room for its name
      const at = Math.min(width - 18, Math.max(18, x(kind.value)));
      write(context, i === 2 ? short(kind.value).replace(" %", "") : short(kind.value), at, floor + 12, "center");
      if (i !== 2) write(context, kind.name.split(" ").at(i === 3 ? 0 : -1), at, floor + 24, "center");
    });
  });
}

// Directions that machines drove in, by sectors from east counter-clockwise.
export function roseChart(sectors) {
  const most = Math.max(...sectors, 1e-9), { ink } = choices;
  return chart(ROSE_PX, "Directions that machines drove in", (context, width) => {
    const x = width / 2, y = 46, radius = 32;
    for (const part of [0.5, 1]) {
      context.beginPath();
      context.arc(x, y, radius * part, 0, 2 * Math.PI);
      stroke(context, ink.faint, 0.75);
    }
    context.fillStyle = ink.accent;
    sectors.forEach((metres, i) => {
      const middle = -2 * Math.PI * i / sectors.length, half = Math.PI / sectors.length;
      context.beginPath();
      context.moveTo(x, y);
      context.arc(x, y, radius * Math.sqrt(metres / most), middle - half, middle + half);
      context.fill();
    });
    context.fillStyle = ink.soft;
    write(context, "N", x, 10, "center");
  });
}

// Rolling resistance over time: spans [{first_ns, last_ns, value}], and a mark where it changed.
export function courseChart(spans, changed_ns) {
  const values = spans.map(({ value }) => value), from = spans[0].first_ns, to = spans.at(-1).last_ns;
  const { ink } = choices, least = Math.min(...values), most = Math.max(...values);
  const low = least * 0.9, high = most * 1.1;
  const label = `From ${percent(values[0])} to ${percent(values.at(-1))} of weight`;
  return chart(COURSE_PX, label, (context, width) => {
    const x = (ns) => LEFT_PX + (width - LEFT_PX - 2) * (ns - from) / Math.max(1, to - from);
    const y = (v) => 6 + (COURSE_PX - 24) * (1 - (v - low) / (high - low));
    context.fillStyle = ink.soft;
    for (const value of y(least) - y(most) < LINE_PX ? [most] : [least, most]) {
      trace(context, [[LEFT_PX, y(value)], [width, y(value)]]);
      stroke(context, ink.hatch, 1);
      write(context, percent(value), 0, y(value) + 4, "left");
    }
    trace(context, spans.flatMap((span) => [[x(span.first_ns), y(span.value)], [x(span.last_ns), y(span.value)]]));
    stroke(context, ink.text, 1.75);
    write(context, clock(from), LEFT_PX, COURSE_PX - 2, "left");
    write(context, clock(to), width, COURSE_PX - 2, "right");
    context.fillStyle = ink.alarm;
    if (changed_ns > from) context.fillRect(x(changed_ns) - 1, 2, 2, COURSE_PX - 20);
  });
}
