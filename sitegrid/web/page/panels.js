// Side panels, one shown at a time. A new one is a module with a line here. It has `title` and
//   build(page, signal)            elements that say what it shows; asks with the signal, which ends what nobody waits for any more
// and, where it needs them,
//   begin()                        what it remembers, as page[NAME]
//   draw(page, context, view)      its marks on the map
//   pick(page, place, point)       takes a place that was chosen on the map (metres, pixels); false: the cell there is explained
//   press(page, key)               takes a key; false: it is the page's
//   link(page), restore(page, parameters)   what a link holds of it; whether a link has it open
//   wholeSite                      while it is open, the site is fitted beside it, unless somebody moved the view
//   everySeconds                   how often it is made anew
import * as agents from "./agents.js";
import * as route from "./route.js";
import * as why from "./why.js";
import * as work from "./work.js";

export const PANELS = { why, work, route, agents };
