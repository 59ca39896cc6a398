// A picture of the site beneath the map: a file and its world file (six lines), kept in this page alone.

export async function readPlan(files) {
  const picture = files.find((file) => file.type.startsWith("image/")), world = files.find((file) => /\.(pgw|jgw|wld)$/i.test(file.name));
  if (!picture || !world) throw new Error("Choose the picture and its world file (.pgw, .jgw or .wld) together.");
  const lines = (await world.text()).trim().split(/\s+/).map(Number);
  if (lines.length !== 6 || lines.some((v) => !Number.isFinite(v)) || lines[0] * lines[3] === lines[1] * lines[2]) throw new Error(`${world.name} is no world file: six numbers, in metres of the site.`);
  return { image: await createImageBitmap(picture), world: lines };
}
