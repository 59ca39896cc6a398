// Side panels. A new one is a module with `title` and `build(page, subject)`, which returns elements, and a line here.
import * as why from "./why.js";

export const PANELS = { why };
