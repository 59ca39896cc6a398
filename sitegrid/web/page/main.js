// The page. What is shown goes one way: people, the link and the door change an owner in state/, the owner tells of it,
// and here stands who shows it: cards, and the picture of the map.
import { showLegend } from "./cards/legend.js";
import { say, showNotice, showNoticeOfEmpty } from "./cards/notice.js";
import { panel } from "./cards/panel.js";
import { buildRail, showRail } from "./cards/rail.js";
import { showSites, showStatus } from "./cards/status.js";
import { buildTimebar, drawStrip, showTimebar } from "./cards/timebar.js";
import { buildTools, showTools } from "./cards/tools.js";
import { onKey } from "./keys.js";
import { keepLink, restoreLink } from "./link.js";
import { showBackdrop } from "./map/base_map.js";
import { canvas, drawFrame, drawFrames, drawn, redraw } from "./map/picture.js";
import { plates } from "./map/pen.js";
import { followPointers } from "./map/pointer.js";
import { fitUnlessMoved, keepInSight } from "./map/sight.js";
import { PANELS } from "./panels/index.js";
import { route } from "./panels/route.js";
import { work } from "./panels/work.js";
import { choices, shown, site, times, view } from "./state/index.js";

const QUIET_MS = 400; // a page that loads faster than this says nothing about it
window.sitegrid = { site, choices, times, view, panel, shown, drawn, plates, route, work }; // for tests

site.on("sites", showSites);
site.on("state", showNotice, showStatus);
site.on("map", () => choices.suit(site.map), showNotice, restoreLink, keepInSight, showLegend, redraw);
site.on("poses", showNoticeOfEmpty, keepInSight, showStatus, redraw);
site.on("backdrop", showBackdrop, showRail, fitUnlessMoved);
site.on("facts", () => times.span(), redraw);
choices.on("layer", showRail, showLegend, keepLink, redraw);
choices.on("shows", showRail, redraw);
choices.on("paper", drawFrame); // it does not wait for the next picture
choices.on("theme", drawStrip, () => panel.again(), redraw);
times.on("times", showTimebar, showStatus, keepLink);
times.on("maps", showLegend, () => panel.follow(), redraw);
times.on("split", redraw);
times.on("failed", () => say("The map of that time could not be read", times.error.message));
view.on("view", keepLink, redraw);
panel.on("opened", showTools, () => panel.shown.wholeSite && fitUnlessMoved(), keepLink, redraw);
panel.on("filled", keepLink, redraw);
panel.on("closed", showTools, fitUnlessMoved, keepLink, redraw, () => canvas.focus({ preventScroll: true }));

panel.offer(PANELS);
choices.begin();
buildRail();
buildTimebar();
buildTools();
showRail();
showLegend();
followPointers();
addEventListener("beforeprint", () => addEventListener("afterprint", choices.printed(), { once: true }));
addEventListener("keydown", onKey);
addEventListener("resize", () => { fitUnlessMoved(); drawStrip(); redraw(); });
drawFrames();
setTimeout(() => { if (site.state === "loading") showNotice(); }, QUIET_MS);
setInterval(() => { showStatus(); redraw(); panel.tick(); }, 1000);
site.open();
