// Card: how long a round length is on the map.
import { byId } from "../elements.js";
import { view } from "../state/index.js";

const MOST_PX = 120;
const LENGTHS_M = [4, 3, 2, 1, 0].flatMap((power) => [5, 2, 1].map((digit) => digit * 10 ** power));

export function showScale() {
  const [text, line] = byId("scale").children, metres = LENGTHS_M.find((m) => m * view.scale <= MOST_PX) ?? 1;
  line.style.width = `${metres * view.scale}px`;
  text.textContent = metres >= 1000 ? `${metres / 1000} km` : `${metres} m`;
}
