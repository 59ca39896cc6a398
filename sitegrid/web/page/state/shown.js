// The map that is on the page, and the layer that its colours show: of now, of another time, or what differs.
import { differenceOf } from "../layers.js";
import { choices } from "./choices.js";
import { site } from "./site.js";
import { difference } from "./tiles.js";
import { times } from "./times.js";

class Shown {
  #made = { key: "", map: null };

  map() {
    const map = times.map ?? site.map, { layer } = choices, { otherMap } = times;
    if (!times.isSubtracted) return { map, layer };
    const key = [map.stamp_ns, map.row, map.fact, otherMap.stamp_ns, otherMap.row, layer.id].join();
    if (this.#made.key !== key) this.#made = { key, map: difference(map, otherMap, layer) };
    return { map: this.#made.map, layer: differenceOf(layer) };
  }

  // Where two times are beside each other, a place on the screen belongs to the time of its half.
  at(left) {
    const isOther = times.isBeside && left < innerWidth * times.split;
    return isOther ? { map: times.otherMap, at: times.other } : { map: times.map ?? site.map, at: times.at };
  }
}

export const shown = new Shown();
