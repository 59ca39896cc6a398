// Card: which time is which half's, where two are beside each other.
import { byId } from "../elements.js";
import { times } from "../state/index.js";

export function showSides() {
  const sides = byId("sides"), [then, now] = sides.children;
  sides.hidden = !times.isBeside;
  if (sides.hidden) return;
  sides.style.left = `${Math.round(innerWidth * times.split)}px`;
  then.textContent = times.words(times.other);
  now.textContent = times.words(times.at);
}
