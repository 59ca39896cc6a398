// The page: what is shown, how it is chosen, and a link that holds it.
import { drawChanges, drawCross, drawGround, drawMachine, drawPlan, inkOf, roundLength } from "./draw.js";
import { Refused, connect, getJson } from "./live.js";
import { KINDS, LAYERS, css, differenceOf, kindOf, layerOf, percent } from "./palette.js";
import { PANELS } from "./panels.js";
import { byId, element, failure, swap } from "./parts.js";
import { readPlan } from "./plan.js";
import { TileMap, difference } from "./tiles.js";
import { TimeBar } from "./time.js";
import { View, follow } from "./view.js";

const SHOWS = [["machines", "Machines", "M"], ["tracks", "Tracks, last minute", "T"], ["changes", "Changed ground", "G"], ["plan", "Site picture", "P"], ["unsure", "Fade what is unsure", "U"], ["old", "Fade what is old", "O"]];
const NOTICES = {
  loading: ["Loading the map", "One moment; the first tiles are on their way."],
  empty: ["No ground known yet", "Start a machine's agent; the map fills as it drives.", "sitegrid agent --config loader-1.toml --site-file site.toml --spool spool.db"],
  driving: ["Machines are driving.", "The map follows a minute or two later.", null, true],
  absent: ["No map server answers", "The map is shown as soon as one does. The first start of one takes about a minute."],
  away: ["No map server answers.", "This is what it said last. Trying again every 2 s.", null, true],
  offline: ["The page's server does not answer.", "This is what it said last. Trying again every 2 s.", null, true],
  refused: ["This link has no permission", "Ask the office for a visitor's token, then open the new link."],
};
const QUIET_MS = 400; // a page that loads faster than this says nothing about it
const PANEL_PX = 420, PANEL_PART = 0.62; // of the window's right that the panel covers; of a phone's height
const HOLD_PX = 14; // beside the line between two times, where it can be taken
const SAID_MS = 6000; // how long what just failed is shown
const AGAIN_MS = 2000; // before a panel that could not be read is asked for again
const NEAR_M = 5, ROOM_M = 15; // around a machine: what is in sight, and what is made so where it leaves that
const ARROW_PX = 14; // around a machine's arrow: a click there is for the machine, not for the ground
const REST_MS = 120; // a pointer that stays so long asks for the value

const asked = new URLSearchParams(location.search);
const page = {
  site: "", map: new TileMap(), machines: new Map(), changes: [], boundaries: [], ink: null, palette: asked.get("palette") ?? "ordered",
  layer: layerOf(asked.get("layer")), shows: { machines: true, tracks: true, changes: true, plan: true, unsure: true, old: false },
  state: "loading", panel: null, failed: false, cell: null, keyboard: false, picture: null, info: null, frames: 0,
  path: (name) => `/api/v1/sites/${page.site}/${name}`,
  asOf: () => page.cellTime ?? page.time.at ?? undefined,
  redraw: () => { page.dirty = true; },
  mapChanged: () => { buildLegend(); page.redraw(); panelFollows(); },
  say: (title, text) => say(title, text),
  openPanel: (name) => openPanel(name),
  fly: (box) => fly(box),
  compareWith: (ns) => page.time.compareWith(ns),
  timeMoved: () => { if (page.site) { showStatus(); keepLink(); } },
};
for (const [name, panel] of Object.entries(PANELS)) page[name] = panel.begin?.();
window.sitegrid = page; // for tests, and for people with a console
const canvas = byId("map"), view = new View();
page.view = view;
page.time = new TimeBar(page);
let disconnect = null, restTimer = 0;
const nowSite_ns = () => (page.time.at ?? page.map.stamp_ns);

// --- what is drawn
function frames() {
  requestAnimationFrame(frames);
  frame();
}
function frame() {
  if (view.advance(performance.now())) { page.dirty = true; if (!view.flight) keepLink(); }
  if (!page.dirty && !page.machines.size) return;
  page.dirty = false;
  const ratio = Math.min(2, devicePixelRatio || 1), [width, height] = [innerWidth, innerHeight];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  Object.assign(view, { width, height });
  const context = canvas.getContext("2d", { alpha: false });
  context.setTransform(1, 0, 0, 1, 0, 0);
  drawGround(context, ratio, page.ink);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  if (page.picture && page.shows.plan) drawPlan(context, view, page.picture);
  context.setTransform(1, 0, 0, 1, 0, 0);
  drawTiles(context, ratio);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  if (page.shows.changes) drawChanges(context, view, page.changes.filter((change) => change.first_ns <= nowSite_ns()), page.ink);
  if (page.panel) PANELS[page.panel].draw?.(page, context, view);
  const labels = [];
  if (page.shows.machines && page.time.at === null) for (const machine of page.machines.values()) drawMachine(context, view, { ...machine, trusted: page.info?.trusted[machine.machine] }, performance.now() / 1000, page.shows, page.ink, labels);
  showSides();
  if (page.keyboard && document.activeElement === canvas) drawCross(context, view, page.ink);
  const metres = roundLength(view.scale, 120), scale = byId("scale");
  scale.lastElementChild.style.width = `${metres * view.scale}px`;
  scale.firstElementChild.textContent = metres >= 1000 ? `${metres / 1000} km` : `${metres} m`;
  page.frames++;
}

const subtracts = () => page.time.mode === "difference" && page.time.otherMap !== null;
const besides = () => page.time.mode === "beside" && page.time.otherMap !== null;
const divider = () => Math.round(innerWidth * page.time.split);

// The map on the page, and the layer that its colours show.
function shownMap() {
  const { time, layer } = page, map = time.map ?? page.map;
  if (!subtracts()) return { map, layer };
  const key = [map.stamp_ns, map.row, map.fact, time.otherMap.stamp_ns, time.otherMap.row, layer.id].join();
  if (page.differenceOf !== key) { page.difference = difference(map, time.otherMap, layer); page.differenceOf = key; }
  return { map: page.difference, layer: differenceOf(layer) };
}

// Which time is which half's.
function showSides() {
  const sides = byId("sides"), [then, now] = sides.children;
  sides.hidden = !besides();
  if (sides.hidden) return;
  sides.style.left = `${divider()}px`;
  then.textContent = page.time.words(page.time.other);
  now.textContent = page.time.words(page.time.at);
}

function drawTiles(context, ratio) {
  const { time } = page, { map: shown, layer } = shownMap();
  if (layer !== page.layer) {
    shown.paint({ layer, colour: layer.colour, now_ns: 0, driven: 0, key: "difference" });
    return shown.draw(context, view, ratio);
  }
  shown.paint(styleOf(shown));
  if (!besides()) return shown.draw(context, view, ratio);
  const middle = divider() * ratio;
  time.otherMap.paint(styleOf(time.otherMap));
  for (const [map, left, width] of [[time.otherMap, 0, middle], [shown, middle, context.canvas.width - middle]]) {
    context.save();
    context.beginPath();
    context.rect(left, 0, width, context.canvas.height);
    context.clip();
    map.draw(context, view, ratio);
    context.restore();
  }
  context.fillStyle = page.ink.text;
  context.fillRect(middle - ratio, 0, 2 * ratio, context.canvas.height);
}

function styleOf(map) {
  const kinds = page.palette === "kinds" && page.layer.id === "resistance";
  const colour = kinds ? (v) => KINDS[Math.min(KINDS.length - 1, kindOf(v, page.boundaries))].rgb : page.layer.colour;
  const key = [page.layer.id, page.palette, page.shows.unsure, page.shows.old, page.ink.driven].join();
  return { layer: page.layer, colour, fade: page.shows.unsure, old: page.shows.old, driven: parseInt(page.ink.driven.slice(1), 16), now_ns: map === page.map ? nowSite_ns() : map.stamp_ns, key };
}

// --- cards
function buildRail() {
  byId("layers").append(...LAYERS.map((layer) => choice("radio", "layer", layer.name, layer.key, layer === page.layer, () => setLayer(layer))));
  byId("shows").append(...SHOWS.map(([name, text, key]) => choice("checkbox", name, text, key, page.shows[name], (on) => setShow(name, on))));
}

function choice(type, name, text, key, checked, set) {
  const input = element("input", { type, name, checked, onchange: (event) => set(event.target.checked) });
  input.dataset.key = key;
  const shape = element("i", {});
  shape.setAttribute("aria-hidden", "true");
  return element("label", { className: `choice ${type}` }, input, shape, element("span", {}, text), element("kbd", {}, key));
}

function setLayer(layer) {
  page.layer = layer;
  const input = [...document.getElementsByName("layer")][LAYERS.indexOf(layer)];
  input.checked = true;
  byId("drawer").textContent = layer.name;
  buildLegend();
  page.redraw();
  keepLink();
}

function setShow(name, on) {
  page.shows[name] = on;
  document.getElementsByName(name)[0].checked = on;
  page.redraw();
}

function buildLegend() {
  const { map, layer } = shownMap(), bins = 48, kinds = layer.id === "resistance" && page.palette === "kinds", differs = layer.id === "difference";
  const { counts, known } = map.values ? map.histogram(layer, bins, nowSite_ns()) : { counts: [], known: 0 };
  const most = Math.max(1, ...counts), strip = element("canvas", { width: 400, height: 72 });
  strip.setAttribute("role", "img");
  strip.setAttribute("aria-label", `${layer.name}: how many cells have which value`);
  const pen = strip.getContext("2d"), one = 400 / bins;
  for (let i = 0; i < bins; i++) {
    const value = inverse(layer, (i + 0.5) / bins), rgb = kinds ? KINDS[Math.min(KINDS.length - 1, kindOf(value, page.boundaries))].rgb : layer.colour(value);
    pen.fillStyle = css(rgb);
    pen.fillRect(Math.floor(i * one), 52, Math.ceil(one), 20);
    const tall = 46 * Math.sqrt((counts[i] ?? 0) / most);
    pen.fillRect(i * one + 1, 50 - tall, one - 2, tall);
  }
  const ticks = element("div", { className: "ticks" }, layer.ticks.map(([at, text]) => { const tick = element("span", {}, text); tick.style.left = `${100 * at}%`; tick.className = at < 0.08 ? "first" : at > 0.92 ? "last" : ""; return tick; }));
  const palettes = swap("palette", [["ordered", "Ordered"], ["kinds", "Kinds of ground"]], page.palette, (name) => { page.palette = name; buildLegend(); page.redraw(); keepLink(); });
  palettes.hidden = layer.id !== "resistance";
  const names = kinds ? element("ul", { className: "kinds" }, KINDS.map((kind) => { const swatch = element("i"); swatch.style.background = css(kind.rgb); return element("li", {}, swatch, kind.name, element("span", {}, percent(kind.value, kind.value < 0.01 ? 1 : 0))); })) : null;
  const unknown = element("p", { className: "unknown" }, element("i", {}), "Unknown", ...(differs ? [" at one of the times"] : [element("i", { className: "driven" }), "Driven only"]));
  byId("legend").replaceChildren(element("h2", { className: "cap" }, differs ? "Difference" : layer.name, element("b", {}, differs ? `${page.time.words(page.time.other)} to ${page.time.words(page.time.at)}` : layer.unit)), strip, ticks, ...[names].filter(Boolean), unknown, palettes);
  byId("known").textContent = known ? `${Math.round(known * page.map.cell_m ** 2).toLocaleString("en")} m² known${differs ? " at both times" : ""}` : "";
}

function inverse(layer, u) { // the value at a place of the palette, by halving
  if (layer.id === "difference") return 2 * u - 1;
  let [low, high] = layer.id === "resistance" ? [0.001, 1] : layer.id === "age" ? [0, 1e7] : [0, 1000];
  for (let i = 0; i < 60; i++) { const middle = (low + high) / 2; if (layer.at(middle) < u) low = middle; else high = middle; }
  return (low + high) / 2;
}

// --- states
function setState(state) {
  if (state === page.state && state !== "loading") return;
  page.state = state;
  const empty = state === "live" && !page.map.tiles.size;
  const kind = state === "away" && !page.map.store ? "absent" : !empty ? state : page.machines.size ? "driving" : "empty";
  const [title, text, command, small] = NOTICES[kind] ?? [];
  const notice = byId("notice");
  notice.hidden = !title;
  notice.classList.toggle("small", Boolean(small) && (page.map.tiles.size > 0 || kind === "driving"));
  if (title) notice.replaceChildren(element("h2", {}, title), element("p", {}, text), ...(command ? [element("code", {}, command)] : []));
  document.body.classList.toggle("blank", kind in NOTICES && !page.map.tiles.size);
  showStatus();
}

function showStatus() {
  const status = byId("status"), at = page.time.at, silent = [...page.machines.values()].filter((m) => performance.now() / 1000 - m.seen_s > 8).length;
  const machines = `${page.machines.size} machine${page.machines.size === 1 ? "" : "s"}`;
  const text = { loading: "Loading", away: "No map server", offline: "Not connected", refused: "No permission" }[page.state]
    ?? (at !== null ? `The map as of ${page.time.words(at)}` : `Live, ${machines}${silent ? `, ${silent} silent` : ""}`);
  status.lastElementChild.textContent = text;
  status.className = ["away", "offline", "refused"].includes(page.state) ? "bad" : page.state === "live" && at === null ? "" : "off";
}

// One line about what just failed; it goes by itself.
let sayTimer = 0;
function say(title, text) {
  const notice = byId("notice");
  clearTimeout(sayTimer);
  notice.replaceChildren(element("h2", {}, title), element("p", {}, text));
  notice.classList.add("small");
  notice.hidden = false;
  sayTimer = setTimeout(() => { const { state } = page; page.state = ""; setState(state); }, SAID_MS);
}

// --- choosing
async function openPanel(name) {
  const panel = byId("panel"), again = page.panel === name;
  const body = again ? panel.lastElementChild : element("div", { className: name }, element("p", { className: "part note" }, "One moment."));
  const close = element("button", { className: "icon", onclick: closePanel, ariaLabel: "Close" }, "×");
  if (!again) panel.replaceChildren(element("header", {}, element("h2", {}, PANELS[name].title), element("small", { role: "status" }), close), body);
  if (name !== "why") page.cell = page.cellTime = null;
  body.classList.add("asking");
  panel.hidden = false;
  document.body.classList.add("open");
  page.opening?.abort(); // nobody waits for what was asked before
  const mine = new AbortController();
  Object.assign(page, { panel: name, panelAt: page.time.at, panelMade_ms: performance.now(), failed: false, opening: mine });
  showTools();
  if (!view.moved && !again && PANELS[name].wholeSite) fit();
  keepLink();
  let parts;
  try {
    parts = await PANELS[name].build(page, mine.signal);
  } catch (error) {
    if (page.opening === mine) parts = [failure(page, error)];
  }
  if (page.opening !== mine) return;
  const focused = body.contains(document.activeElement) ? document.activeElement.id : "";
  body.replaceChildren(...parts.filter(Boolean));
  if (focused) byId(focused)?.focus({ preventScroll: true });
  page.opening = null;
  body.classList.remove("asking");
  page.redraw();
}

// The panel is of the time that is shown, once that stands still.
function panelFollows() {
  if (!page.panel || page.time.playing || page.panelAt === page.time.at) return;
  page.cellTime = null;
  openPanel(page.panel);
}

// What is on the page while the map changes is made anew now and then.
function panelAges() {
  const seconds = PANELS[page.panel]?.everySeconds;
  if (seconds && !page.opening && page.time.at === null && performance.now() - page.panelMade_ms > 1000 * seconds) openPanel(page.panel);
}

// What could not be read is asked for again once the map server is there.
function panelFailed() {
  if (page.failed && page.panel && !page.opening && page.state === "live" && performance.now() - page.panelMade_ms > AGAIN_MS) openPanel(page.panel);
}

function closePanel() {
  page.opening?.abort();
  byId("panel").hidden = true;
  document.body.classList.remove("open");
  page.panel = page.cell = page.cellTime = page.opening = null;
  showTools();
  if (!view.moved) fit();
  page.redraw();
  keepLink();
  canvas.focus({ preventScroll: true });
}

const togglePanel = (name) => (page.panel === name ? closePanel() : openPanel(name));
function showTools() {
  for (const name of ["agents", "work", "route"]) byId(`open-${name}`).setAttribute("aria-pressed", page.panel === name);
}

const cellAt = (left, top) => view.toSite(left, top).map((v) => Math.floor(v / page.map.cell_m));
// Where two times are beside each other, a place belongs to the time of its half.
const timeAt = (left) => (besides() && left < divider() ? page.time.other : page.time.at) ?? undefined;
const mapAt = (left) => (besides() && left < divider() ? page.time.otherMap : page.time.map ?? page.map);

// A place that was chosen: the panel's, or a cell to explain.
function choose(left, top) {
  if (page.panel && PANELS[page.panel].pick?.(page, view.toSite(left, top), [left, top])) return;
  const machine = machineAt(left, top);
  if (!machine) return void explain(left, top);
  page.agents.chosen = machine;
  openPanel("agents");
}

// The machine that is drawn there.
function machineAt(left, top) {
  if (!page.shows.machines || page.time.at !== null) return null;
  const away = ({ x_m, y_m }) => { const [x, y] = view.toScreen(x_m, y_m); return Math.hypot(x - left, y - top); };
  const nearest = [...page.machines.values()].sort((a, b) => away(a) - away(b))[0];
  return nearest && away(nearest) < ARROW_PX ? nearest.machine : null;
}

function explain(left, top) {
  page.cellTime = timeAt(left);
  rest(null);
  page.cell = cellAt(left, top);
  if (isPhone()) { view.shift(view.width / 2 - left, view.height * 0.28 - top); page.redraw(); } // above the panel
  else if (left > innerWidth - PANEL_PX) { view.shift(innerWidth - PANEL_PX - left, 0); page.redraw(); } // beside it
  openPanel("why");
}

function rest(left, top) {
  clearTimeout(restTimer);
  const readout = byId("readout");
  if (left === null) { readout.classList.remove("on"); return; }
  restTimer = setTimeout(() => showValue(left, top), REST_MS);
}

async function showValue(left, top) {
  const [column, row] = cellAt(left, top), shown = mapAt(left), readout = byId("readout");
  if (!shown.values || Number.isNaN(shown.at(column, row, "visits"))) { readout.classList.remove("on"); return; }
  const name = { age: "age_s" }[page.layer.id] ?? page.layer.id, std = { resistance: "resistance_std", grade: "grade_std" }[page.layer.id];
  const layers = [name, "resistance_class", ...(std ? [std] : [])];
  try {
    const at = { x: (column + 0.5) * shown.cell_m, y: (row + 0.5) * shown.cell_m, layers: layers.join() };
    const ask = async (as_of) => (await getJson(page.path("point"), { ...at, as_of, repairs: as_of ? undefined : 1 })).values; // as tiles are
    const [values, then] = await Promise.all([ask(timeAt(left)), subtracts() ? ask(page.time.other) : null]);
    const was = then && `${then[name] === null ? "not measured" : page.layer.text(then[name])} → `;
    const value = values[name], kind = KINDS[values.resistance_class];
    const spread = std && values[std] !== null ? ` ± ${(100 * values[std]).toFixed(1)}` : "";
    readout.replaceChildren(element("b", {}, was ?? "", value === null ? "not measured" : page.layer.text(value) + spread), element("small", {}, `${kind ? `${kind.name} · ` : ""}${(column * shown.cell_m).toFixed(0)} m E, ${(row * shown.cell_m).toFixed(0)} m N`));
    readout.dataset.value = value ?? "";
    readout.style.left = `${Math.min(innerWidth - 200, left + 14)}px`;
    readout.style.top = `${Math.max(8, top - 46)}px`;
    readout.classList.add("on");
  } catch { readout.classList.remove("on"); }
}

// --- keys
const KEYS = [["1 to 5", "Layer"], ["M T G P U O", "Show and hide"], ["Arrows, + −", "Move, zoom"], ["0", "Fit the site"], ["W, R, A", "Where to send the grader, what a drive costs, how machines do"], ["Enter", "Explain the cell at the cross"], ["Space, [ ]", "Play, step in time"], ["L", "Back to now"], ["C", "Compare two times"], ["D", "Light or dark"], ["Esc", "Close"]];
function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(select|textarea)$/i.test(event.target.tagName)) return;
  const inField = event.target.type === "number"; // its keys are its own, but for the one that closes
  if (inField && event.key !== "Escape") return;
  const inRange = event.target.type === "range", onButton = event.target.tagName === "BUTTON" || event.target.type === "checkbox" || event.target.type === "radio";
  const key = event.key.length === 1 ? event.key.toUpperCase() : event.key, move = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[key];
  const layer = LAYERS.find((one) => one.key === key), show = SHOWS.find(([, , letter]) => letter === key);
  if (move && document.activeElement === canvas) { view.shift(...move); page.keyboard = true; page.redraw(); keepLink(); }
  else if (page.panel && !inField && PANELS[page.panel].press?.(page, key)) page.redraw();
  else if (key === "Enter" && event.target === canvas) choose(view.width / 2, view.height / 2);
  else if (key === "+" || key === "=") zoomBy(1.4);
  else if (key === "-" || key === "−") zoomBy(1 / 1.4);
  else if (key === "0") fit();
  else if (layer) setLayer(layer);
  else if (show) setShow(show[0], !page.shows[show[0]]);
  else if (key === " " && !onButton && !inRange) page.time.play();
  else if (key === "[") page.time.step(-1);
  else if (key === "]") page.time.step(1);
  else if (key === "L") page.time.goLive();
  else if (key === "C") page.time.nextMode();
  else if (key === "W") togglePanel("work");
  else if (key === "R") togglePanel("route");
  else if (key === "A") togglePanel("agents");
  else if (key === "D") setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  else if (key === "?") help();
  else if (key === "Escape" && page.panel) closePanel();
  else return;
  event.preventDefault();
}
const zoomBy = (factor) => { view.zoom(factor); page.redraw(); keepLink(); };

function help() {
  const dialog = byId("help");
  dialog.replaceChildren(element("h2", {}, "Keys"), element("dl", { className: "facts" }, KEYS.flatMap(([key, what]) => [element("dt", {}, key), element("dd", {}, what)])), element("button", { className: "act", onclick: () => dialog.close() }, "Close"));
  dialog.showModal();
}

function fit() {
  Object.assign(view, { width: innerWidth, height: innerHeight }); // before the first picture too
  view.margins = margins(PANELS[page.panel]?.wholeSite);
  page.fitted = groundAndMachines(ROOM_M);
  view.fit(page.fitted ?? [-50, -50, 50, 50]);
  page.redraw();
  keepLink();
}

// A map that grows and machines that drive stay in sight, as long as nobody has moved the view.
function keepInSight() {
  if (view.moved || page.time.at !== null || (page.state === "loading" && !page.restored)) return;
  const near = groundAndMachines(NEAR_M);
  if (!near || !page.fitted) return near && fit();
  if (around([page.fitted, near]).every((edge, i) => edge === page.fitted[i])) return;
  page.fitted = around([page.fitted, groundAndMachines(ROOM_M)]);
  view.fly(page.fitted, view.margins, moves());
  view.moved = false;
}

const isPhone = () => innerWidth <= 720;
const margins = (besidePanel) => (isPhone() ? [16, 172, 16, besidePanel ? PANEL_PART * innerHeight + 32 : 130] : [272, 66, besidePanel ? PANEL_PX : 24, 96]);
const moves = () => !matchMedia("(prefers-reduced-motion: reduce)").matches;
function fly(box) {
  view.fly(box, margins(true), moves());
  page.redraw();
}

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  try { localStorage.setItem("theme", name); } catch { /* a browser that keeps nothing */ }
  page.ink = inkOf(document.documentElement);
  page.time.show();
  if (page.panel) openPanel(page.panel);
  page.redraw();
}

// On paper: light, whatever the screen is.
let screenTheme = null;
function printed(on) {
  if (on) screenTheme = document.documentElement.dataset.theme;
  document.documentElement.dataset.theme = on ? "light" : screenTheme;
  page.ink = inkOf(document.documentElement);
  page.dirty = true;
  frame(); // the paper does not wait for the next picture
}

// --- the link to this view
let linkTimer = 0;
function keepLink() {
  clearTimeout(linkTimer);
  linkTimer = setTimeout(() => history.replaceState(null, "", linkOf()), 250);
}
function linkOf() {
  const parts = { site: page.site, layer: page.layer.id, palette: page.palette };
  if (view.moved) parts.at = `${view.x.toFixed(1)},${view.y.toFixed(1)},${view.scale.toFixed(2)}`;
  if (page.time.at !== null) parts.time = new Date(page.time.at / 1e6).toISOString();
  if (page.time.other !== null) Object.assign(parts, { other: new Date(page.time.other / 1e6).toISOString(), mode: page.time.mode });
  if (page.panel) Object.assign(parts, PANELS[page.panel].link(page));
  return `${location.pathname}?${new URLSearchParams(parts)}`;
}

const around = (boxes) => [0, 1, 2, 3].map((i) => (i < 2 ? Math.min : Math.max)(...boxes.map((box) => box[i])));
function groundAndMachines(room_m) { // null where neither is known
  const boxes = [...page.machines.values()].map(({ x_m: x, y_m: y }) => [x - room_m, y - room_m, x + room_m, y + room_m]), ground = page.map.bounds();
  return ground || boxes.length ? around(ground ? [ground, ...boxes] : boxes) : null;
}

function restoreLink() {
  const at = asked.get("at")?.split(",").map(Number), time = Date.parse(asked.get("time")), other = Date.parse(asked.get("other"));
  if (at?.length === 3 && at.every(Number.isFinite)) { [view.x, view.y, view.scale] = at; view.moved = true; } else fit();
  if (!Number.isNaN(time)) page.time.go(time * 1e6);
  if (!Number.isNaN(other)) { page.time.mode = asked.get("mode") === "difference" ? "difference" : "beside"; page.time.compareWith(other * 1e6); }
  const open = Object.keys(PANELS).find((name) => PANELS[name].restore(page, asked));
  if (open) openPanel(open);
}

// --- what the door sends
const on = {
  state(state) { setState(state); },
  frame(received) {
    const first = !page.map.tiles.size && received.tiles.length > 0;
    page.map.take(received);
    page.state = "loading"; // so that the state is shown anew: the map may have been empty until now
    setState("live");
    if (first && !page.restored) { page.restored = true; restoreLink(); }
    keepInSight();
    page.received = performance.now();
    buildLegend();
    page.redraw();
  },
  poses(poses) {
    const now_s = performance.now() / 1000, known = page.machines.size;
    for (const pose of poses) {
      const machine = page.machines.get(pose.machine) ?? { track: [] }, seen_s = now_s - pose.age_s;
      machine.track.push({ x_m: pose.x_m, y_m: pose.y_m, seen_s });
      while (machine.track.length && now_s - machine.track[0].seen_s > 60) machine.track.shift();
      page.machines.set(pose.machine, { ...machine, ...pose, seen_s });
    }
    if (page.state === "live" && !page.map.tiles.size && !known) { page.state = "loading"; setState("live"); } // their ground comes later
    keepInSight();
    page.redraw();
    showStatus();
  },
  site(site) {
    page.info = site;
    page.changes = site.changes;
    page.boundaries = site.boundaries;
    if (page.map.store) page.map.stamp_ns = Math.max(page.map.stamp_ns, site.stamp_ns); // time goes on where nobody drives
    page.time.span(site.first_ns, site.stamp_ns);
    page.redraw();
  },
};

async function start() {
  let theme = asked.get("theme");
  try { theme ??= localStorage.getItem("theme"); } catch { /* a browser that keeps nothing */ }
  document.documentElement.dataset.theme = theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  page.ink = inkOf(document.documentElement);
  buildRail();
  setLayer(page.layer);
  setTimeout(() => { if (page.state === "loading" && !page.map.tiles.size) { page.state = ""; setState("loading"); } }, QUIET_MS);
  follow(canvas, view, { changed: () => { page.redraw(); keepLink(); }, rest, choose,
    holds: (left) => besides() && Math.abs(left - divider()) < HOLD_PX,
    divide: (left) => { page.time.split = Math.min(0.98, Math.max(0.02, left / innerWidth)); page.redraw(); } });
  addEventListener("beforeprint", () => printed(true));
  addEventListener("afterprint", () => printed(false));
  addEventListener("keydown", onKey);
  addEventListener("resize", () => { if (!view.moved) fit(); page.time.drawStrip(); page.redraw(); });
  for (const name of ["agents", "work", "route"]) byId(`open-${name}`).onclick = () => togglePanel(name);
  byId("fit").onclick = fit;
  byId("theme").onclick = () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  byId("keys").onclick = help;
  byId("link").onclick = async () => { await navigator.clipboard?.writeText(location.origin + linkOf()); byId("link").classList.add("done"); setTimeout(() => byId("link").classList.remove("done"), 900); };
  byId("plan").onclick = () => byId("plan-file").click();
  byId("plan-file").onchange = async (event) => { try { page.picture = await readPlan([...event.target.files]); setShow("plan", true); } catch (error) { say("This picture cannot be shown", error.message); } event.target.value = ""; };
  byId("drawer").onclick = () => { const open = byId("rail").classList.toggle("full"); byId("drawer").setAttribute("aria-expanded", open); };
  requestAnimationFrame(frames);
  setInterval(() => { showStatus(); page.redraw(); panelAges(); panelFailed(); }, 1000);
  await chooseSite();
}

async function chooseSite() {
  let sites;
  try {
    ({ sites } = await getJson("/api/v1/sites"));
  } catch (error) {
    setState(error instanceof Refused && [401, 403].includes(error.status) ? "refused" : "offline");
    return void setTimeout(chooseSite, 2000);
  }
  const names = sites.map((site) => site.name);
  page.site = names.includes(asked.get("site")) ? asked.get("site") : names[0];
  document.title = `${page.site} · sitegrid`;
  byId("site").textContent = page.site;
  byId("sites").hidden = names.length < 2;
  byId("choose-site").replaceChildren(...names.map((name) => element("option", { value: name, selected: name === page.site }, name)));
  byId("choose-site").onchange = (event) => { location.search = new URLSearchParams({ site: event.target.value }); };
  disconnect?.();
  disconnect = connect(page.site, page.map, on);
}

start();
