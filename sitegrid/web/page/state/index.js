// What is shown, and who owns it: only an owner's methods change it.
export { choices } from "./choices.js";
export { Refused, getJson } from "./door.js";
export { Owner, parameter } from "./owner.js";
export { shown } from "./shown.js";
export { site } from "./site.js";
export { CELLS, around } from "./tiles.js";
export { times } from "./times.js";
export { view } from "./view.js";
