// What was changed by transactions, and a tree that is wanted: what it would change, and the change itself.

import { difference, order, outcome } from "./acting.js";
import { actorLink, clock, el, moment, sentence } from "./dom.js";
import { isKnown, live } from "./live.js";
import { ask, question, session } from "./server.js";

const KINDS = ["TransactionCommitted", "TransactionRolledBack", "ScriptLoaded", "SpecificationNotKept", "SpecificationSuperseded", "MechanismAttached", "MechanismChanged", "MechanismDetached", "MechanismSettled", "Moved"];
let draft = "";

export function changesView(main) {
  const past = el("div"), result = el("div", { role: "status" });
  const text = el("textarea", { "aria-label": "The tree that is wanted, in TOML", spellcheck: "false", value: draft, placeholder: 'below = "/app/stock"\n\n["/app/stock"]\nsupervisor = "one_for_one"\nintensity = 9\nperiod = 10.0' });
  text.addEventListener("input", () => { draft = text.value; });
  const run = async (isDryRun) => {
    const done = await order("apply", [], { text: text.value, isDryRun });
    if (!done) return;
    const steps = done.steps.length ? outcome(done) : el("p", {}, "Nothing to do: it is as wanted.");
    result.replaceChildren(el("h2", {}, isDryRun ? "What would be done" : "Done"), steps, isDryRun && done.steps.length ? el("p", { class: "faint" }, "Nothing was done so far.") : "");
    load();
  };
  const wanted = session.role !== "operate" ? null : el("section", { class: "card" }, el("h2", {}, "A tree that is wanted"),
    el("p", { class: "faint" }, "As in `holdfast plan` and `holdfast apply`: the smallest change from what runs to what is written here, as one transaction. What stays keeps its state."),
    text, el("div", { class: "bar" }, el("button", { type: "button", "data-verb": "plan", onclick: () => run(true) }, "Plan"), el("button", { type: "button", class: "main", "data-verb": "apply", onclick: () => run(false) }, "Apply")), result);
  main.replaceChildren(el("div", { class: "wide" }, el("h1", {}, "Changes"), wanted, el("section", { class: "card" }, el("h2", {}, "What was changed"), past)));
  let isOver = false, last = -2;
  const load = async () => {
    const newest = live.events.filter((one) => KINDS.includes(one.kind)).at(-1)?.number ?? -1;
    if (newest === last) return;
    last = newest;
    try {
      const page = await ask({ ask: "history", question: question({ kinds: KINDS, limit: 100 }) });
      if (!isOver) past.replaceChildren(page.events.length ? el("div", { class: "scroll" }, el("table", {}, el("tbody", {}, page.events.reverse().map(changeRow)))) : el("p", { class: "empty" }, "Nothing was changed so far."));
    } catch (error) { past.replaceChildren(el("p", { class: "empty" }, error.message)); }
  };
  live.addEventListener("events", load);
  load();
  return () => { isOver = true; live.removeEventListener("events", load); };
}

function changeRow(one) {
  const isBack = one.kind === "TransactionRolledBack", fields = one.fields;
  const said = fields.steps ? el("ol", { class: "steps" }, [].concat(fields.steps).map((step) => el("li", {}, sentence(String(step), isKnown)))) : Object.entries(fields).map(([name, value]) => `${name}=${value}`).join(" ");
  return el("tr", {}, el("td", { class: "time", title: moment(one.at) }, clock(one.at)), el("td", {}, actorLink(one.address)),
    el("td", {}, el("span", { class: isBack ? "chip ill" : "chip" }, one.kind === "TransactionCommitted" ? "done" : isBack ? "undone" : one.kind)),
    el("td", {}, said, isBack ? el("p", {}, `${fields.step}: ${fields.reason}`) : null, fields.problems?.length ? el("p", {}, `not tidied up: ${fields.problems}`) : null, fields.difference ? difference([].concat(fields.difference)) : null));
}
