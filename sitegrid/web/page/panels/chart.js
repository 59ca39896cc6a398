// A chart: a canvas of a height, which `draw(context, width)` fills, again with `redraw`; `label` has its figures too.
import { element } from "../elements.js";
import { font, sized } from "../map/pen.js";

export function chart(height, label, draw) {
  const canvas = element("canvas", { role: "img", ariaLabel: label, style: `height: ${height}px` });
  const redraw = () => {
    const width = canvas.clientWidth;
    if (!width) return;
    const context = sized(canvas, width, height);
    font(context, "11px");
    draw(context, width);
  };
  new ResizeObserver(redraw).observe(canvas); // also when it is first on the page: only then it has a width
  return Object.assign(canvas, { redraw });
}

export function write(context, text, x, y, align) {
  context.textAlign = align;
  context.fillText(text, x, y);
}
