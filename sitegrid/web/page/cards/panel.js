// Card: the side panel, which shows one thing at a time; what a panel has stands in panels/index.js.
import { byId, element } from "../elements.js";
import { Owner, Refused, site, times } from "../state/index.js";

const AGAIN_MS = 2000; // before a panel that could not be read is asked for again
const SILENCE = "The page's server does not answer. It is asked again when it is back.";

// Tells of "opened", "closed" and "filled".
class Panel extends Owner {
  name = null;
  at = null; // the time that it is of
  #panels = {};
  #opening = null; // ends what is asked
  #made_ms = 0;
  #isFailed = false;

  offer(panels) { this.#panels = panels; }

  get shown() { return this.#panels[this.name]; }

  // Open a panel, or make it anew.
  async open(name) {
    const isNew = name !== this.name, root = byId("panel"), mine = new AbortController();
    this.#opening?.abort(); // nobody waits for what was asked before
    this.#opening = mine;
    this.#made_ms = performance.now();
    this.#isFailed = false;
    Object.assign(this, { name, at: times.at });
    if (isNew) root.replaceChildren(this.#header(), element("div", { className: name }, note("One moment.")));
    const body = root.lastElementChild;
    body.classList.add("asking");
    root.hidden = false;
    document.body.classList.add("open");
    this.tell(isNew ? "opened" : "filled");
    const parts = await this.shown.build(mine.signal).catch((error) => [this.#opening === mine && this.failure(error)]);
    if (this.#opening !== mine) return;
    const focused = body.contains(document.activeElement) ? document.activeElement.id : "";
    body.replaceChildren(...parts.filter(Boolean));
    if (focused) byId(focused)?.focus({ preventScroll: true });
    this.#opening = null;
    body.classList.remove("asking");
    this.tell("filled");
  }

  #header() {
    const close = element("button", { className: "icon", onclick: () => this.close(), ariaLabel: "Close" }, "×");
    return element("header", {}, element("h2", {}, this.shown.title), element("small", { role: "status" }), close);
  }

  toggle(name) { if (this.name === name) this.close(); else this.open(name); }

  again() { if (this.name) this.open(this.name); }

  close() {
    this.#opening?.abort();
    byId("panel").hidden = true;
    document.body.classList.remove("open");
    this.name = this.#opening = null;
    this.tell("closed");
  }

  // It is of the time that is shown, once that stands still.
  follow() {
    if (!this.name || times.playing || this.at === times.at) return;
    this.shown.follow?.();
    this.again();
  }

  // Once a second: what is on the page while the map changes is made anew now and then; what could not be read, too.
  tick() {
    if (!this.name || this.#opening) return;
    const age_ms = performance.now() - this.#made_ms, isOld = age_ms > 1000 * (this.shown.everySeconds ?? Infinity);
    if ((isOld && times.at === null) || (this.#isFailed && site.state === "live" && age_ms > AGAIN_MS)) this.again();
  }

  // What could not be read, and why; it is asked for again once the server is back.
  failure(error) {
    this.#isFailed = !(error instanceof Refused) || error.status >= 500;
    return element("section", { className: "part" },
      element("p", { className: "say failed", role: "alert" }, error instanceof Refused ? error.message : SILENCE),
      element("button", { id: "again", className: "act", onclick: () => this.again() }, "Try again"));
  }
}

const note = (text) => element("p", { className: "part note" }, text);

export const panel = new Panel();
