// Card: what hinders the page from showing a map, or what just failed.
import { byId, element } from "../elements.js";
import { site } from "../state/index.js";

const AGENT = "sitegrid agent --config loader-1.toml --site-file site.toml --spool spool.db";
const LAST = "This is what it said last. Trying again every 2 s.";
const NOTICES = { // title, text, and what is special
  loading: ["Loading the map", "One moment; the first tiles are on their way."],
  empty: ["No ground known yet", "Start a machine's agent; the map fills as it drives.", { command: AGENT }],
  driving: ["Machines are driving.", "The map follows a minute or two later.", { isSmall: true }],
  absent: ["No map server answers",
    "The map is shown as soon as one does. The first start of one takes about a minute."],
  away: ["No map server answers.", LAST, { isSmall: true }],
  offline: ["The page's server does not answer.", LAST, { isSmall: true }],
  refused: ["This link has no permission", "Ask the office for a visitor's token, then open the new link."],
};
const SAID_MS = 6000; // how long what just failed is shown
let kind, timer = 0;

function currentKind() {
  if (site.state === "away" && !site.map.store) return "absent";
  if (site.state !== "live" || !site.isEmpty) return site.state;
  return site.machines.size ? "driving" : "empty";
}

export function showNotice() {
  kind = currentKind();
  const [title, text, { command, isSmall = false } = {}] = NOTICES[kind] ?? [];
  document.body.classList.toggle("blank", kind in NOTICES && site.isEmpty);
  show(title, text, isSmall && (!site.isEmpty || kind === "driving"), command);
}

// Ground and machines that come to an empty map.
export function showNoticeOfEmpty() { if (site.isEmpty && kind !== currentKind()) showNotice(); }

// One line about what just failed; it goes by itself.
export function say(title, text) {
  show(title, text, true);
  timer = setTimeout(showNotice, SAID_MS);
}

function show(title, text, isSmall, command) {
  const notice = byId("notice");
  clearTimeout(timer);
  notice.hidden = !title;
  notice.classList.toggle("small", isSmall);
  if (!title) return;
  notice.replaceChildren(element("h2", {}, title), element("p", {}, text), command ? element("code", {}, command) : "");
}
