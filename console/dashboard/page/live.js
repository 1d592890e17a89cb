// The system as it was told last: rows, what needs attention, events, processes, and a few series of numbers.

import { stream, watch, whoAmI } from "./server.js";
import { aboveOf, nameOf } from "./dom.js";

const FIELDS = ["path", "kind", "state", "place", "pid", "restarts", "queued", "turn", "since", "recovery", "mechanism", "names", "restart", "isSupervisor", "allowed", "rests"];
const KEPT_EVENTS = 500, KEPT_POINTS = 300;

export const live = new EventTarget();
Object.assign(live, {
  system: "", pid: 0, viewer: 0, skew: 0, isConnected: false, isJudged: false, problem: "",
  rows: new Map(), tops: [], processes: new Map(), troubles: [], quarantine: [], events: [], series: new Map(), structure: 0,
});

export const now = () => Date.now() / 1000 + live.skew;
export const turnSeconds = (row) => (row.turn ? Math.max(0, now() - row.since) : 0);
export const isKnown = (path) => live.rows.has(path);
export const ownProcess = (row) => (row.place !== "task" || !aboveOf(row.path) ? live.processes.get(row.pid) : undefined);

let pending = new Set(), isDrawing = false;
function tell(...kinds) {
  for (const kind of kinds) pending.add(kind);
  if (isDrawing) return;
  isDrawing = true;
  const draw = () => {
    if (!isDrawing) return;
    isDrawing = false;
    const told = pending;
    pending = new Set();
    for (const kind of told) live.dispatchEvent(new Event(kind));
  };
  requestAnimationFrame(draw);
  setTimeout(draw, 150); // A page in the background has no frames.
}

function rowOf(values) {
  const row = { kids: [] };
  FIELDS.forEach((name, at) => { row[name] = values[at]; });
  row.name = nameOf(row.path);
  return row;
}

function put(values, behind) {
  const known = live.rows.get(values[0]);
  if (known) {
    FIELDS.forEach((name, at) => { known[name] = values[at]; });
    return;
  }
  const row = rowOf(values);
  live.rows.set(row.path, row);
  const above = live.rows.get(aboveOf(row.path));
  row.depth = above ? above.depth + 1 : 0;
  const siblings = above ? above.kids : live.tops;
  if (behind === undefined) siblings.push(row);
  else siblings.splice(behind ? siblings.findIndex((one) => one.path === behind) + 1 : 0, 0, row);
  live.structure += 1;
}

function drop(path) {
  const row = live.rows.get(path);
  if (!row) return;
  live.rows.delete(path);
  const above = live.rows.get(aboveOf(path));
  const siblings = above ? above.kids : live.tops;
  const at = siblings.indexOf(row);
  if (at >= 0) siblings.splice(at, 1);
  live.structure += 1;
}

function processes(told) {
  if (told) live.processes = new Map(told.map(([pid, memory, cpu]) => [pid, { pid, memory, cpu }]));
}

function add(key, label, unit, value) {
  let one = live.series.get(key);
  if (!one) live.series.set(key, (one = { key, label, unit, points: [], at: 0 }));
  one.points.push(value);
  one.at = Date.now();
  if (one.points.length > KEPT_POINTS) one.points.shift();
}

let eventsSeen = 0;
function measure() {
  if (!live.isConnected || !live.rows.size) return;
  let queued = 0, longest = 0, restarts = 0, odd = 0;
  for (const row of live.rows.values()) {
    queued += row.queued;
    longest = Math.max(longest, row.queued);
    restarts += row.restarts;
    if (row.state !== "running") odd += 1;
  }
  add("actors", "actors", "", live.rows.size);
  add("queued", "messages that wait", "", queued);
  add("longest", "the longest mailbox", "", longest);
  add("restarts", "restarts of those who live", "", restarts);
  add("odd", "actors that do not run", "", odd);
  add("events", "events", "/s", eventsSeen);
  eventsSeen = 0;
  const owners = new Map();
  for (const row of live.rows.values()) if (row.pid && ownProcess(row) && !owners.has(row.pid)) owners.set(row.pid, row.path);
  for (const one of [...live.processes.values()].sort((a, b) => b.memory - a.memory).slice(0, 12)) {
    const whose = owners.get(one.pid) || "process";
    add(`m${one.pid}`, `${whose} (pid ${one.pid})`, "MB", one.memory / 1e6);
    if (one.cpu !== null) add(`c${one.pid}`, `${whose} (pid ${one.pid})`, "%", one.cpu);
  }
  for (const [key, one] of live.series) if (Date.now() - one.at > 60000) live.series.delete(key);
  tell("series");
}

export function connect() {
  const timer = setInterval(measure, 1000);
  const close = stream("live", {
    open() { live.isConnected = true; tell("connection"); },
    broken() {
      live.isConnected = false;
      tell("connection");
      whoAmI().catch(() => {}); // If the login is over, the page says so.
    },
    snapshot(told) {
      live.rows.clear();
      live.tops.length = 0;
      live.structure += 1;
      for (const values of told.rows) put(values);
      Object.assign(live, { system: told.system, pid: told.pid, viewer: told.viewer, problem: told.problem, troubles: told.troubles, quarantine: told.quarantine, isJudged: told.is_judged, events: told.events });
      live.skew = told.now - Date.now() / 1000;
      processes(told.processes);
      tell("connection", "rows", "troubles", "events");
    },
    change(told) {
      live.problem = "";
      for (const path of told.gone || []) drop(path);
      for (const [values, behind] of told.rows || []) put(values, behind ?? undefined);
      processes(told.processes);
      tell("rows");
    },
    events(told) {
      eventsSeen += told.length;
      const last = live.events.length ? live.events[live.events.length - 1].number : -1;
      live.events.push(...told.filter((one) => one.number > last));
      live.events.splice(0, live.events.length - KEPT_EVENTS);
      tell("events");
    },
    troubles(told) {
      live.troubles = told.troubles;
      live.quarantine = told.quarantine;
      live.isJudged = true;
      tell("troubles");
    },
    problem(told) { live.problem = told.text; tell("connection"); },
  });
  return () => { clearInterval(timer); live.viewer = 0; close(); };
}

let watched = "", watchTimer = 0;
// Says which rows are on the screen: in a large system these are looked at more often than the others.
export function onScreen(paths) {
  const key = paths.join("\n");
  if (key === watched || !live.viewer) return;
  clearTimeout(watchTimer);
  watchTimer = setTimeout(() => {
    if (!live.viewer) return; // It was closed meanwhile.
    watched = key;
    watch(live.viewer, paths.slice(0, 200)).catch(() => { watched = ""; });
  }, 120);
}
live.addEventListener("connection", () => { watched = ""; });
