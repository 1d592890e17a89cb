// What has happened: chosen by address and kind, and followed.

import { actorLink, clock, el, moment } from "./dom.js";
import { live } from "./live.js";
import { ask, question } from "./server.js";

const HIDDEN = new Set(["traceback", "reason_kind", "turns", "longest_turn", "longest_message"]);
const SHOWN = 300;

export function eventTable(events, withAddress = true) {
  if (!events.length) return el("p", { class: "empty" }, "Nothing has happened.");
  return el("div", { class: "scroll" }, el("table", {}, el("tbody", {}, events.map((one) => eventRow(one, withAddress)))));
}

function eventRow(one, withAddress) {
  const fields = Object.entries(one.fields).filter(([name]) => !HIDDEN.has(name)).map(([name, value]) => `${name}=${typeof value === "object" ? JSON.stringify(value) : value}`).join(" ");
  const said = one.fields.traceback ? el("details", {}, el("summary", {}, fields), el("pre", {}, String(one.fields.traceback))) : fields;
  return el("tr", { "data-key": one.number }, el("td", { class: "time", title: `${moment(one.at)}, number ${one.number}` }, clock(one.at)), withAddress ? el("td", {}, actorLink(one.address)) : null, el("td", {}, one.kind), el("td", { class: "faint" }, said));
}

export function eventsView(main) {
  const path = el("input", { type: "text", class: "grow", placeholder: "all, or a pattern: /app/bank/**", "aria-label": "Addresses", spellcheck: "false" });
  const kind = el("input", { type: "text", placeholder: "all kinds", list: "kinds", "aria-label": "Kind of event", spellcheck: "false" });
  const kinds = el("datalist", { id: "kinds" });
  const follows = el("input", { type: "checkbox", id: "follows", checked: true });
  const body = el("tbody"), told = el("p", { class: "faint", role: "status" });
  follows.checked = true;
  main.replaceChildren(el("h1", {}, "Events"), el("form", { class: "bar", onsubmit: (event) => { event.preventDefault(); load(); } }, path, kind, kinds,
    el("button", { class: "main" }, "Show"), el("label", { for: "follows" }, follows, "follow")), told, el("div", { class: "scroll" }, el("table", {}, body)));
  let last = -1, isOver = false, isAsking = false;
  const chosen = (more) => question({ path: path.value.trim() || "**", kinds: kind.value.trim() ? [kind.value.trim()] : [], ...more });
  async function load() {
    try {
      const page = await ask({ ask: "history", question: chosen({ limit: SHOWN }) });
      if (isOver) return;
      last = page.next;
      body.replaceChildren(...page.events.reverse().map((one) => eventRow(one, true)));
      told.textContent = page.events.length ? "" : "Nothing of this kind has happened.";
    } catch (error) { told.textContent = error.message; }
  }
  async function goOn() {
    const names = new Set([...kinds.children].map((one) => one.value));
    for (const one of live.events) if (!names.has(one.kind)) { names.add(one.kind); kinds.append(el("option", { value: one.kind })); }
    if (!follows.checked || isAsking || last < 0) return;
    isAsking = true;
    try {
      const page = await ask({ ask: "history", question: chosen({ after: last, limit: SHOWN }) });
      if (isOver) return;
      last = page.next;
      body.prepend(...page.events.reverse().map((one) => eventRow(one, true)));
      while (body.children.length > SHOWN) body.lastElementChild.remove();
      if (page.events.length) told.textContent = "";
    } catch (error) { told.textContent = error.message; } finally { isAsking = false; }
  }
  live.addEventListener("events", goOn);
  load().then(goOn);
  return () => { isOver = true; live.removeEventListener("events", goOn); };
}
