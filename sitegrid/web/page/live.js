// The door: requests, and the live connection, which comes back by itself.
import { readFrame } from "./tiles.js";

const AGAIN_S = 2;

export class Refused extends Error { constructor(status, problem) { super(problem.detail ?? problem.title ?? `refused with ${status}`); this.status = status; } }

export async function get(path, parameters = {}, signal = undefined) {
  const query = new URLSearchParams(Object.entries(parameters).filter(([, value]) => value !== undefined && value !== null));
  const answer = await fetch(`${path}${query.size ? `?${query}` : ""}`, { credentials: "same-origin", signal });
  if (!answer.ok) throw new Refused(answer.status, await answer.json().catch(() => ({})));
  return answer;
}
export const getJson = async (path, parameters, signal) => (await get(path, parameters, signal)).json();
export const getFrame = async (path, parameters) => readFrame(await (await get(path, parameters)).arrayBuffer());

// Keeps a live connection. on.state("live" | "away" | "refused" | "offline"), on.frame(frame), on.poses(list), on.site(table).
export function connect(site, map, on) {
  let socket = null, closed = false, order = Promise.resolve();
  const open = () => {
    if (closed) return;
    const known = map.store ? { store: map.store, row: map.row, fact: map.fact } : {};
    const query = new URLSearchParams(known).toString();
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/v1/sites/${site}/live${query ? `?${query}` : ""}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => { order = order.then(() => receive(data)).catch((error) => console.warn(error)); };
    socket.onclose = (event) => {
      if (closed) return;
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
  return () => { closed = true; socket?.close(); };
}
