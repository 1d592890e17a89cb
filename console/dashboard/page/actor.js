// One actor: what it does now and for what it waits, what has become of its lives, and what can be done.

import { dialog, note, order, orderButton } from "./acting.js";
import { lifeLine, mechanism, recoveries, spark } from "./charts.js";
import { aboveOf, actorHref, actorLink, bytes, clock, el, moment, plural, seconds, sentence, shortKind, table } from "./dom.js";
import { eventTable } from "./event_list.js";
import { isKnown, live, now, ownProcess, turnSeconds } from "./live.js";
import { ask, question, session, stream } from "./server.js";
import { gravity } from "./tree.js";

const AGAIN = 1000;
const OBEYED = /[\x00-\x08\x0a-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]/g;
const shownAs = (sign) => (sign < "\u0100" ? `\\x${sign.charCodeAt(0).toString(16).padStart(2, "0")}` : `\\u${sign.charCodeAt(0).toString(16)}`);

export function actorView(main, path, more) {
  const crumbs = el("h1", { class: "crumbs" }), chips = el("p"), bar = el("div", { class: "bar", role: "toolbar", "aria-label": "What can be done" });
  const why = el("div"), nowBox = el("dl"), mailbox = el("div"), lives = el("div"), ties = el("div"), shield = el("div"), events = el("div"), spec = el("div"), state = el("div"), trace = el("div");
  const lines = el("pre", { class: "mono", tabindex: "0", role: "log", "aria-label": "Last lines" });
  const section = (title, ...body) => el("section", { class: "card" }, el("h2", {}, title), body);
  const shieldCard = section("Mechanism", shield), stateCard = section("State", state), traceCard = section("Messages", trace), linesCard = section("Last lines", lines);
  main.replaceChildren(el("div", { class: "wide" }, crumbs, chips, bar, section("Why", why),
    el("div", { class: "cards" }, section("Now", nowBox, mailbox), section("Ties", ties)), shieldCard, section("Lives and recoveries", lives), stateCard, traceCard, linesCard, section("Events", events), section("Spec", spec)));
  crumbs.append(...path.split("/").slice(1).flatMap((name, at, all) => {
    const upTo = "/" + all.slice(0, at + 1).join("/");
    return [el("span", { class: "sep" }, "/"), at === all.length - 1 ? name : actorLink(upTo, name)];
  }));
  const queue = [], printed = [];
  let isOver = false, isAsking = false, barKey = "", timer = 0, endTrace = null, lastSaid = "", isReading = false, lastLine = null;

  function draw() {
    const row = live.rows.get(path);
    const turn = row ? turnSeconds(row) : 0;
    const chip = (text, kind = "") => el("span", { class: `chip ${kind}` }, text);
    chips.replaceChildren(...(row ? [chip(row.state, gravity(row.state) || "well"), " ", el("span", { class: "faint" }, shortKind(row.kind)), " ",
      turn >= 1 ? [chip(`${row.rests ? "rests in" : "in"} ${shortKind(row.turn)} for ${seconds(turn)}`, row.rests ? "" : turn >= 5 ? "ill" : "odd"), " "] : null,
      row.restarts ? [chip(plural(row.restarts, "restart"), "odd"), " "] : null, row.mechanism.length ? chip(row.mechanism.join(" + ")) : null].flat().filter(Boolean) : [chip("not there now", "odd")]));
    const verbs = !row ? [] : row.state === "stopped" ? ["start", "remove"] : [row.state === "suspended" ? "resume" : "suspend", "restart", "kill", "stop", "checkpoint", "remove"];
    const usable = verbs.filter((verb) => aboveOf(path) || ["suspend", "resume"].includes(verb)).filter((verb) => verb !== "checkpoint" || row.recovery);
    const key = usable.join();
    if (key !== barKey) {
      barKey = key;
      bar.replaceChildren(...usable.map((verb) => orderButton(verb, [path], { after: load })).filter(Boolean));
      if (row && session.role === "operate" && row.state !== "stopped") bar.append(
        el("button", { type: "button", "data-verb": "protect", onclick: () => protect(path, row).then(load) }, "Protect…"),
        el("button", { type: "button", "data-verb": "bind", onclick: () => bind(path).then(load) }, "Bind…"));
    }
    if (row) {
      queue.push(row.queued);
      if (queue.length > 240) queue.shift();
    }
  }

  async function load() {
    if (isAsking || isOver) return;
    isAsking = true;
    try {
      const [said, told, past] = await Promise.all([
        ask({ ask: "why", path, timeout: 3 }), ask({ ask: "inspect", path, timeout: 3 }).catch((error) => ({ problem: error.message })),
        ask({ ask: "lives", path }).catch(() => [])]);
      if (!isOver) fill(said, told, past);
    } catch (error) {
      if (!isOver) why.replaceChildren(el("p", {}, error.message));
    } finally { isAsking = false; }
  }

  function fill(said, told, past) {
    if (JSON.stringify(said) !== lastSaid) why.replaceChildren(...said.map((one) => el("p", {}, sentence(one, isKnown))));
    lastSaid = JSON.stringify(said);
    const row = told.actor, process = row && live.rows.get(path) && ownProcess(live.rows.get(path));
    const item = (name, value) => (value === "" || value === null || value === undefined ? null : [el("dt", {}, name), el("dd", {}, value)]);
    nowBox.replaceChildren(...(!row ? [el("dt", {}, "now"), el("dd", {}, told.problem)] : [
      item("class", row.kind), item("state", row.state), item("life", told.life ? `${told.life} (${plural(row.restarts, "restart")})` : ""),
      item("place", `${row.place}, pid ${row.pid || "none"}`), item("queued", plural(row.queued, "message")),
      row.turn ? item("turn", `${row.turn}, for ${seconds(row.turn_seconds)}`) : null, item("recovery", row.recovery || "none"),
      told.process ? item("memory", `${bytes(told.process.memory_bytes)}, of its process${row.allowed_bytes ? `; it may have ${bytes(row.allowed_bytes)}` : ""}`) : null,
      told.process ? item("processor", `${told.process.cpu_seconds.toFixed(1)} s${process && process.cpu !== null ? ` (${process.cpu} % now)` : ""}, of its process`) : null,
      told.supervises ? item("supervises", `${plural(told.supervises.children, "child", "children")}, ${told.supervises.strategy}; ${told.supervises.restarts} of ${told.supervises.intensity} restarts within ${told.supervises.period} s used up`) : null,
    ]).flat().filter(Boolean));
    mailbox.replaceChildren(...(queue.length > 2 && Math.max(...queue) > 0 ? [el("p", { class: "faint" }, `mailbox, at most ${Math.max(...queue)}`), spark(queue)] : []));
    const linked = (name, paths) => (paths?.length ? [el("dt", {}, name), el("dd", {}, paths.map((one, at) => [at ? ", " : "", actorLink(one)]))] : []);
    const tied = row ? [linked("supervisor", aboveOf(path) ? [aboveOf(path)] : []), row.names.length ? [el("dt", {}, "names"), el("dd", {}, row.names.join(", "))] : [],
      linked("links", told.links), linked("watched by", told.monitors),
      Object.entries(told.bindings || {}).map(([port, target]) => [el("dt", {}, `binding ${port}`), el("dd", {}, actorLink(target), " ", orderButton("unbind", [path], { words: [port], after: load }))])].flat(3) : [];
    ties.replaceChildren(tied.length ? el("dl", {}, tied) : el("p", { class: "empty" }, "It has none."));
    shieldCard.hidden = !told.protection;
    if (told.protection) shield.replaceChildren(el("p", { class: "faint" }, `${told.protection.is_whole ? "whole" : "not whole"} since ${moment(told.protection.since)}${told.protection.is_changing ? ", changing" : ""}${told.protection.is_on_probation ? ", on probation" : ""}`), el("div", { class: "scroll" }, mechanism(told.protection, told.bricks || {})));
    const newest = [...past].reverse();
    lives.replaceChildren(...[past.length ? el("div", { class: "scroll" }, lifeLine(past, now())) : null, table([["life"], ["began", "time"], ["ended", "time"], ["how"], ["turns", "num"]],
      newest.map((life) => [String(life.number), life.started === null ? "not started" : clock(life.started), life.ended === null ? "goes on" : clock(life.ended), ending(life), life.turns === null ? "" : String(life.turns)]), "The history knows of no life here."),
      recoveries(past) ? el("h2", {}, "Recoveries") : null, recoveries(past)].filter(Boolean));
    spec.replaceChildren(told.spec && Object.keys(told.spec).length ? el("dl", {}, Object.entries(told.spec).flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, String(value))])) : el("p", { class: "empty" }, "No supervisor has started it."));
    draw();
  }

  async function loadEvents() {
    try {
      const page = await ask({ ask: "history", question: question({ path: path.replace(/[*?[]/g, "[$&]"), limit: 60 }) });
      if (!isOver) events.replaceChildren(eventTable(page.events.reverse(), false));
    } catch (error) { events.replaceChildren(el("p", { class: "empty" }, error.message)); }
  }

  async function loadLines() {
    if (isOver || isReading || !session.sees_state) return;
    isReading = true;
    try {
      const page = await ask({ ask: "logs", question: { path: path.replace(/[*?[]/g, "[$&]"), after: lastLine, limit: 300 } });
      if (page.dropped && lastLine !== null) printed.push(`${plural(page.dropped, "line")} came too fast and are not shown`);
      for (const one of page.lines) printed.push(`${clock(one.at)} ${one.life ? `life ${one.life} ` : ""}${one.source === "holdfast" ? one.level : one.source}: ${one.text.replace(OBEYED, shownAs)}`);
      printed.splice(0, printed.length - 300);
      if (page.lines.length || lastLine === null) lines.textContent = printed.join("\n") || "No line of it is kept.";
      lastLine = page.next;
    } catch (error) { lines.textContent = error.message; } finally { isReading = false; }
  }

  async function showState() {
    try {
      const found = await ask({ ask: "state", path });
      state.replaceChildren(el("dl", {}, Object.entries(found).flatMap(([name, text]) => [el("dt", {}, name || "state"), el("dd", {}, el("code", {}, text))])),
        el("p", { class: "faint" }, `as it was at ${clock(now())}, in outline`), stateButton("Again"));
    } catch (error) { note(error.message, true); }
  }
  const stateButton = (label) => el("button", { type: "button", "data-verb": "state", onclick: showState }, label);

  function follow() {
    const lines = el("pre", { class: "mono", tabindex: "0", role: "log", "aria-label": "Messages" }), said = [];
    const stop = el("button", { type: "button", onclick: () => { endTrace?.(); endTrace = null; trace.replaceChildren(lines, followButton()); } }, "Stop following");
    trace.replaceChildren(stop, lines);
    endTrace = stream(`trace?path=${encodeURIComponent(path)}`, {
      again: false,
      trace(told) {
        for (const one of told.events) said.unshift(`${clock(one.at)} ${one.what === "TurnEnded" ? `ended ${shortKind(one.type)}, ${(one.seconds * 1000).toFixed(1)} ms, ${one.outcome}` : `${{ MessageIn: "in   ", TurnBegan: "turn ", MessageOut: "out  " }[one.what] || one.what} ${one.message || ""}${one.to ? ` to ${one.to}` : ""}`}`);
        said.splice(300);
        lines.textContent = said.join("\n") || "Nothing yet.";
      },
      problem(told) { lines.textContent = told.text; },
    });
  }
  const followButton = () => el("button", { type: "button", "data-verb": "trace", onclick: follow }, "Follow its messages");

  stateCard.hidden = traceCard.hidden = linesCard.hidden = !session.sees_state;
  state.replaceChildren(stateButton("Show its state"));
  trace.replaceChildren(followButton());
  const onRows = () => { draw(); };
  const onEvents = () => { if (live.events.some((one) => one.address === path && one.number > newestSeen)) { newestSeen = live.events[live.events.length - 1].number; load(); loadEvents(); } };
  let newestSeen = live.events.length ? live.events[live.events.length - 1].number : -1;
  live.addEventListener("rows", onRows);
  live.addEventListener("events", onEvents);
  timer = setInterval(() => { if (document.visibilityState === "visible") { load(); loadLines(); } }, AGAIN);
  draw();
  load();
  loadEvents();
  loadLines();
  if (more === "state" && session.sees_state) showState().then(() => stateCard.scrollIntoView({ block: "center" }));
  return () => { isOver = true; clearInterval(timer); endTrace?.(); live.removeEventListener("rows", onRows); live.removeEventListener("events", onEvents); };
}

function ending(life) {
  const parts = [];
  if (life.ended !== null) parts.push(life.reason || "ended");
  if (life.handling) parts.push(`handling ${life.handling}`);
  if (life.by) parts.push(`by ${life.by}${life.because ? ` (${life.because})` : ""}`);
  if (life.restarts !== null) parts.push(`restart ${life.restarts} of ${life.allowed}`);
  if (life.longest_message) parts.push(`longest turn ${life.longest_turn.toFixed(1)} s with ${life.longest_message}`);
  if (life.replayed) parts.push(`${life.replayed} replayed`);
  const text = parts.join(", ");
  return life.traceback ? el("details", {}, el("summary", {}, text), el("pre", {}, life.traceback)) : text;
}

async function protect(path, row) {
  const field = el("input", { type: "text", value: row.mechanism.join(" "), placeholder: "pbr, lfr, tr… outermost first; empty: none", "aria-label": "Mechanisms, outermost first" });
  const words = await dialog(`Protect ${path}`, el("div", {}, el("p", {}, "It is protected by just these mechanisms, whatever it has now; its life goes on."), field), "Protect", { read: () => field.value.split(/[\s,]+/).filter(Boolean) });
  if (words) await order("protect", [path], { words });
}

async function bind(path) {
  const port = el("input", { type: "text", required: true, placeholder: "port", "aria-label": "Port" });
  const target = el("input", { type: "text", required: true, placeholder: "/app/…", "aria-label": "Target", list: "none" });
  const words = await dialog(`Bind ${path}`, el("div", { class: "bar" }, port, target), "Bind", { read: () => [port.value.trim(), target.value.trim()] });
  if (words) await order("bind", [path], { words });
}
