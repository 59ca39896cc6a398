// Who owns a part of the page's state: only its own methods change it, and they tell of what; whoever shows it watches.

export class Owner {
  #watchers = {};

  on(what, ...watchers) { (this.#watchers[what] ??= []).push(...watchers); }
  become(what, changes) { Object.assign(this, changes); this.tell(what); }
  tell(what) { for (const watcher of this.#watchers[what] ?? []) watcher(); }
}

const asked = new URLSearchParams(location.search); // the link that opened the page
export const parameter = (name) => asked.get(name);

// What a browser keeps between visits, if it keeps anything.
export const kept = (name) => { try { return localStorage.getItem(name); } catch { return null; } };
export const keep = (name, value) => { try { localStorage.setItem(name, value); } catch { /* it keeps nothing */ } };
