// Pieces of the page: elements without markup in strings, so that no machine's name becomes markup.

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

// A part of a panel, and one with a heading.
export const section = (...children) => element("section", { className: "part" }, ...children);
export const part = (title, note, ...children) =>
  section(element("h3", { className: "cap" }, title, element("b", {}, note ?? "")), ...children);

export const say = (text) => element("p", { className: "say" }, text);
export const note = (text) => element("p", { className: "note" }, text);
export const swatch = (colour) => element("i", { style: `background: ${colour}` });

// Rows of [name, value].
export const facts = (rows) =>
  element("dl", { className: "facts" },
    rows.filter(Boolean).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));

// A figure that is an answer, its unit, and a line beneath.
export const amount = (value, unit, beneath) =>
  element("div", {}, element("b", {}, `${value}`, element("em", {}, ` ${unit}`)), element("span", {}, beneath));

// One of a few choices; ids are NAME-CHOICE.
export const swap = (name, choices, chosen, choose) =>
  element("div", { className: "swap", role: "group" }, choices.map(([choice, text]) =>
    element("button",
      { id: `${name}-${choice}`, ariaPressed: choice === chosen, onclick: () => choose(choice) }, text)));
