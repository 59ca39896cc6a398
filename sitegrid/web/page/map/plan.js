// A layer of the map: a picture of the site from a file and its world file (six lines), kept in this page alone.
import { choices, view } from "../state/index.js";

let plan = null; // {image, world}: the picture and the lines of its world file

export async function readPlan(files) {
  const picture = files.find((file) => file.type.startsWith("image/"));
  const world = files.find((file) => /\.(pgw|jgw|wld)$/i.test(file.name));
  if (!picture || !world) throw new Error("Choose the picture and its world file (.pgw, .jgw or .wld) together.");
  const lines = (await world.text()).trim().split(/\s+/).map(Number), [a, d, b, e] = lines;
  if (lines.length !== 6 || !lines.every(Number.isFinite) || a * e === d * b) {
    throw new Error(`${world.name} is no world file: six numbers, in metres of the site.`);
  }
  plan = { image: await createImageBitmap(picture), world: lines };
  choices.setShow("plan", true);
}

// Pixel (column, row) lies at a*column + b*row + c, d*column + e*row + f.
export function drawPlan(context) {
  if (!plan || !choices.shows.plan) return;
  const [a, d, b, e, c, f] = plan.world, s = view.scale;
  const [left, top] = view.toScreen(c - a / 2 - b / 2, f - d / 2 - e / 2);
  context.save();
  context.globalAlpha = 0.55;
  context.transform(a * s, -d * s, b * s, -e * s, left, top);
  context.drawImage(plan.image, 0, 0);
  context.restore();
}
