// Panel: what each machine says of itself: how it does, what it lacks, what waits. The chosen one comes first.
import { getJson } from "./live.js";
import { element, facts } from "./parts.js";

export const title = "Machines", everySeconds = 2;
export const begin = () => ({ chosen: null });
const SILENT_S = 8;

export async function build(page, signal) {
  const { agents } = await getJson(page.path("agents"), {}, signal), { chosen } = page.agents;
  if (!agents.length) return [element("section", { className: "part" }, element("p", { className: "say" }, "No machine says anything. It appears here as soon as its agent runs, also before it has a place."))];
  const isFirst = (agent) => agent.machine === chosen;
  return [...agents.filter(isFirst), ...agents.filter((agent) => !isFirst(agent))].map((agent) => card(page, agent));
}

function card(page, agent) {
  const silent = agent.age_s > SILENT_S, others = agent.problems.filter((problem) => problem !== agent.status);
  const state = silent ? "off" : agent.problems.length ? "bad" : "", place = page.machines.get(agent.machine);
  const name = element("button", { className: "name", disabled: !place, title: "Show it on the map", onclick: () => page.fly([place.x_m - 30, place.y_m - 30, place.x_m + 30, place.y_m + 30]) }, agent.machine);
  const heading = element("h3", { className: state }, element("i", { className: "dot" }), name, element("small", {}, silent ? `silent for ${Math.round(agent.age_s)} s` : agent.speed_mps === null ? "" : `${Math.abs(agent.speed_mps).toFixed(1)} m/s`));
  return element("section", { className: "part agent" }, heading,
    agent.status ? element("p", { className: agent.problems.includes(agent.status) ? "say failed" : "say" }, sentence(agent.status)) : null,
    others.length ? element("ul", { className: "note problems" }, others.map((problem) => element("li", {}, sentence(problem)))) : null,
    facts(rows(agent)));
}

function rows(agent) {
  const { position_std_m: std, samples, acknowledged, waiting, base, corrections_age_s: age, calibration_std: calibration, heard } = agent;
  return [
    ["Place", std === null ? "not known yet" : `± ${std < 1 ? `${(100 * std).toFixed(0)} cm` : `${std.toFixed(1)} m`}`],
    samples ? ["Samples", `${samples} drawn, ${acknowledged ?? 0} delivered`] : null,
    waiting ? ["In the spool", `${waiting}`] : null,
    heard.length ? ["Sensors", heard.join(", ")] : null,
    base === null ? null : ["Corrections", age === null ? `${base}, none yet` : `${base}, ${age.toFixed(age < 10 ? 1 : 0)} s old`],
    samples && calibration !== null ? ["Slope known to", `± ${(100 * calibration).toFixed(2)} %`] : null,
  ];
}

const sentence = (text) => (/^[a-z]+[ :,]/.test(text) && !text.includes("://", 2) ? text.charAt(0).toUpperCase() + text.slice(1) : text); // not the name of a sensor or port

export const link = () => ({ panel: "agents" });
export const restore = (page, parameters) => parameters.get("panel") === "agents";
