// The site that is shown: its map, machines and changes, as the door sends them, and whether it answers.
import { Refused, connect, getJson } from "./door.js";
import { Owner, parameter } from "./owner.js";
import { TileMap } from "./tiles.js";

const AGAIN_MS = 2000; // before a server that did not answer is asked for its sites again
const TRACK_S = 60; // of a machine's places that are kept
const SILENT_S = 8; // without a word, as in the map server
const now_s = () => performance.now() / 1000;

// Tells of "sites", "state", "map" (new tiles), "poses", "facts" (changes, trust, times) and "backdrop".
class Site extends Owner {
  name = "";
  names = [];
  state = "loading"; // or live, away (no map server), offline (no web server), refused
  map = new TileMap();
  machines = new Map();
  changes = [];
  boundaries = []; // of rolling resistance, between the kinds of ground
  trusted = {};
  backdrop = null; // outline and base map of the site, once the page's server has said them
  first_ns = 0;
  stamp_ns = 0;

  get isEmpty() { return !this.map.tiles.size; }

  path(name) { return `/api/v1/sites/${this.name}/${name}`; }

  // Choose the link's site, or the first, and follow it.
  async open() {
    try {
      this.names = (await getJson("/api/v1/sites")).sites.map((site) => site.name);
    } catch (error) {
      this.#turn(error instanceof Refused && [401, 403].includes(error.status) ? "refused" : "offline");
      return void setTimeout(() => this.open(), AGAIN_MS);
    }
    this.name = this.names.find((name) => name === parameter("site")) ?? this.names[0];
    this.tell("sites");
    connect(this.name, this.map, {
      state: (state) => this.#turn(state),
      frame: (frame) => this.#takeFrame(frame),
      poses: (poses) => this.#takePoses(poses),
      site: (facts) => this.#takeFacts(facts),
    });
  }

  isSilent(machine) { return now_s() - machine.seen_s > SILENT_S; }

  #turn(state) {
    if (state === this.state) return;
    this.become("state", { state });
    if (state === "live" && !this.backdrop) this.#askBackdrop();
  }

  async #askBackdrop() {
    try {
      this.become("backdrop", { backdrop: await getJson(this.path("backdrop")) });
    } catch (error) { this.become("backdrop", { backdrop: { outline: [], problem: error.message } }); }
  }

  #takeFrame(frame) {
    this.map.take(frame);
    this.#turn("live");
    this.tell("map");
  }

  #takePoses(poses) {
    for (const pose of poses) {
      const seen_s = now_s() - pose.age_s, track = this.machines.get(pose.machine)?.track ?? [];
      track.push({ x_m: pose.x_m, y_m: pose.y_m, seen_s });
      while (track.length && now_s() - track[0].seen_s > TRACK_S) track.shift();
      this.machines.set(pose.machine, { ...pose, track, seen_s });
    }
    this.tell("poses");
  }

  #takeFacts({ changes, boundaries, trusted, first_ns, stamp_ns }) {
    if (this.map.store) this.map.stamp_ns = Math.max(this.map.stamp_ns, stamp_ns); // time goes on where nobody drives
    this.become("facts", { changes, boundaries, trusted, first_ns, stamp_ns });
  }
}

export const site = new Site();
