// Side panels, one shown at a time. A new one is a module with a line here. It has `title` and
//   build(signal)        promises elements that say what it shows; asks with the signal, which ends what nobody awaits
// and, where it needs them,
//   draw(context)        its marks on the map
//   pick(place, point)   takes a place that was chosen on the map (metres, pixels); false: the cell there is explained
//   press(key)           takes a key; false: it is the page's
//   link(), restore()    what a link holds of it; whether the link that opened the page has it open
//   follow()             another time is shown, and it will be made anew
//   wholeSite            while it is open, the site is fitted beside it, unless somebody moved the view
//   everySeconds         how often it is made anew
import * as agents from "./agents.js";
import * as route from "./route.js";
import * as why from "./why.js";
import * as work from "./work.js";

export const PANELS = { why, work, route, agents };
