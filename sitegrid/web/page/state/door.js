// The door: requests, and the live connection, which comes back by itself.
import { readFrame } from "./tiles.js";

const AGAIN_S = 2;

export class Refused extends Error {
  constructor(status, problem) {
    super(problem.detail ?? problem.title ?? `refused with ${status}`);
    this.status = status;
  }
}

async function get(path, parameters = {}, signal = undefined) {
  const given = Object.entries(parameters).filter(([, value]) => value !== undefined && value !== null);
  const query = new URLSearchParams(given);
  const answer = await fetch(`${path}${query.size ? `?${query}` : ""}`, { credentials: "same-origin", signal });
  if (!answer.ok) throw new Refused(answer.status, await answer.json().catch(() => ({})));
  return answer;
}
export const getJson = async (path, parameters, signal) => (await get(path, parameters, signal)).json();
export const getFrame = async (path, parameters) => readFrame(await (await get(path, parameters)).arrayBuffer());

// Keeps a live connection: on.state("live" | "away" | "refused" | "offline"), on.frame(frame), on.poses(list),
// on.site(table).
export function connect(site, map, on) {
  let socket = null, order = Promise.resolve();
  const open = () => {
    const known = map.store ? `?${new URLSearchParams({ store: map.store, row: map.row, fact: map.fact })}` : "";
    const address = `${location.host}/api/v1/sites/${site}/live${known}`;
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${address}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => { order = order.then(() => receive(data)).catch((error) => console.warn(error)); };
    socket.onclose = (event) => {
      on.state(event.code === 4401 ? "refused" : "offline");
      setTimeout(open, AGAIN_S * 1000);
    };
  };
  const receive = async (data) => {
    if (typeof data !== "string") {
      const frame = await readFrame(data);
      on.frame(frame);
      socket.send(JSON.stringify({ row: frame.row, fact: frame.fact })); // only then does the door send the next one
      return;
    }
    const message = JSON.parse(data);
    if (message.state) on.state(message.state);
    if (message.poses) on.poses(message.poses);
    if (message.site) on.site(message.site);
  };
  open();
}
