// What the map can be coloured by. A layer says which plane of a tile it shows, and how values become colours, words:
// at, of: from a value to a place on the palette, 0 to 1, and back. ticks: [place, text]. asked, std: names in a query.
// fades: [plane that fades a cell, how sure its value is, 0 to 1].
// change: [what two values differ by, -1 to 1; the words for -1 and 1].
import { diverging, ink, ordered } from "./colours.js";
import { ago, percent, short } from "./words.js";

const linear = (low, high) => ({ at: (v) => (v - low) / (high - low), of: (u) => low + u * (high - low) });
const logarithmic = (low, high) =>
  ({ at: (v) => Math.log(v / low) / Math.log(high / low), of: (u) => low * (high / low) ** u });

const TYPICAL = logarithmic(0.006, 0.3); // ends of the palette of rolling resistance
const AGE = { at: (v) => Math.log(1 + v / 10) / Math.log(8641), of: (u) => 10 * (8641 ** u - 1) };
const STEEP = linear(0, 0.3), PASSES = logarithmic(1, 60), LIKELY = linear(0.3, 1);

// A share of 40 % of the votes, or a deviation of 10 % of slope, is hardly more than a guess.
export const LAYERS = [
  { id: "resistance", name: "Rolling resistance", unit: "% of weight", key: "1", plane: "resistance",
    asked: "resistance", std: "resistance_std", fades: ["confidence", (v) => (v - 0.4) / 0.5],
    ...TYPICAL, colour: (v) => ordered(TYPICAL.at(v)), text: (v) => percent(v),
    ticks: [0.008, 0.02, 0.06, 0.25].map((v) => [TYPICAL.at(v), short(v)]),
    change: [(now, then) => Math.log(now / then) / Math.log(4), "a quarter", "four times"] },
  { id: "grade", name: "Slope", unit: "rise per length", key: "2", plane: "grade",
    asked: "grade", std: "grade_std", fades: ["grade_std", (v) => (0.1 - v) / 0.08],
    ...STEEP, colour: (v) => ink(STEEP.at(v)), text: (v) => percent(v),
    ticks: [[0, "level"], [0.333, "10 %"], [0.667, "20 %"], [1, "30 %"]],
    change: [(now, then) => (now - then) / 0.2, "−20 %", "+20 %"] },
  { id: "visits", name: "Passes", unit: "visits of machines", key: "3", plane: "visits", asked: "visits",
    ...PASSES, colour: (v) => ink(PASSES.at(v)), text: (v) => `${Math.round(v)}`,
    ticks: [[0, "1"], [0.39, "5"], [0.73, "20"], [1, "60"]],
    change: [(now, then) => (now - then) / 20, "20 fewer", "20 more"] },
  { id: "age", name: "Age", unit: "newest sample", key: "4", plane: "since", asked: "age_s",
    ...AGE, colour: (v) => ink(1 - AGE.at(v)), text: ago,
    ticks: [[0, "now"], [0.215, "1 min"], [0.65, "1 h"], [1, "1 d"]],
    change: [(now, then) => Math.sign(now - then) * Math.log(1 + Math.abs(now - then) / 10) / Math.log(361),
      "1 h fresher", "1 h older"] },
  { id: "confidence", name: "Confidence", unit: "likely right", key: "5", plane: "confidence", asked: "confidence",
    ...LIKELY, colour: (v) => ink(LIKELY.at(v)), text: (v) => percent(v, 0),
    ticks: [[0, "30 %"], [0.43, "60 %"], [1, "100 %"]],
    change: [(now, then) => (now - then) / 0.5, "−50 %", "+50 %"] },
];

// How a layer differs between two times, as a layer of its own.
export const differenceOf = ({ name, change: [, less, more] }) =>
  ({ id: "difference", name, unit: "then to now", plane: "difference", colour: diverging, ...linear(-1, 1),
    ticks: [[0, less], [0.5, "same"], [1, more]] });
