// Panel: what each machine says of itself: how it does, what it lacks, what waits. The chosen one comes first.
import { panel } from "../cards/panel.js";
import { element, facts, say, section } from "../elements.js";
import { fly } from "../map/sight.js";
import { getJson, parameter, site } from "../state/index.js";

export const title = "Machines", everySeconds = 2;
const SILENT_S = 8, AROUND_M = 30;
const NOBODY = "No machine says anything. It appears here as soon as its agent runs, also before it has a place.";
let chosen = null;

export function choose(machine) {
  chosen = machine;
  panel.open("agents");
}

export async function build(signal) {
  const { agents } = await getJson(site.path("agents"), {}, signal), isOther = (agent) => agent.machine !== chosen;
  return agents.length ? agents.sort((a, b) => isOther(a) - isOther(b)).map(card) : [section(say(NOBODY))];
}

function card(agent) {
  const { status, problems } = agent, others = problems.filter((problem) => problem !== status);
  const said = { className: problems.includes(status) ? "say failed" : "say" };
  return element("section", { className: "part agent" }, heading(agent),
    status ? element("p", said, sentence(status)) : null,
    others.length ? element("ul", { className: "note problems" }, others.map((problem) =>
      element("li", {}, sentence(problem)))) : null,
    facts(rows(agent)));
}

function heading({ machine, age_s, problems, speed_mps: speed }) {
  const isSilent = age_s > SILENT_S, place = site.machines.get(machine);
  const show = () => fly([place.x_m - AROUND_M, place.y_m - AROUND_M, place.x_m + AROUND_M, place.y_m + AROUND_M]);
  const moves = speed === null ? "" : `${Math.abs(speed).toFixed(1)} m/s`;
  const className = isSilent ? "off" : problems.length ? "bad" : "";
  return element("h3", { className }, element("i", { className: "dot" }),
    element("button", { className: "name", disabled: !place, title: "Show it on the map", onclick: show }, machine),
    element("small", {}, isSilent ? `silent for ${Math.round(age_s)} s` : moves));
}

function rows({ position_std_m: std, samples, acknowledged, waiting, heard, base, lanes, ...agent }) {
  const { calibration_std: calibration, corrections_age_s: age } = agent;
  const close = std < 1 ? `${(100 * std).toFixed(0)} cm` : `${std?.toFixed(1)} m`;
  const old = age === null ? "none yet" : `${age.toFixed(age < 10 ? 1 : 0)} s old`;
  return [
    ["Place", std === null ? "not known yet" : `± ${close}`],
    lanes ? ["Lanes", lanes] : null,
    samples ? ["Samples", `${samples} drawn, ${acknowledged ?? 0} delivered`] : null,
    waiting ? ["In the spool", `${waiting}`] : null,
    heard.length ? ["Sensors", heard.join(", ")] : null,
    base === null ? null : ["Corrections", `${base}, ${old}`],
    samples && calibration !== null ? ["Slope known to", `± ${(100 * calibration).toFixed(2)} %`] : null,
  ];
}

// With a capital, unless it begins with the name of a sensor or port.
const isSentence = (text) => /^[a-z]+[ :,]/.test(text) && !text.includes("://", 2);
const sentence = (text) => (isSentence(text) ? text.charAt(0).toUpperCase() + text.slice(1) : text);

export const link = () => ({ panel: "agents" });
export const restore = () => parameter("panel") === "agents";
