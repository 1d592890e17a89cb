// What the diagnosis of the system says, and how far repair goes: plans that wait for a yes are at the top.

import { dialog, order, orderButton } from "./acting.js";
import { causes, story } from "./charts.js";
import { actorLink, clock, el, sentence, table } from "./dom.js";
import { isKnown } from "./live.js";
import { ask, session } from "./server.js";

export function diagnosisView(main) {
  const body = el("div", { class: "wide" });
  main.replaceChildren(body);
  let isOver = false, shown = "", runs = false;
  async function load() {
    try {
      const found = await ask({ ask: "diagnosis", path: null, timeout: 5 });
      runs = true;
      const key = JSON.stringify([found, session.role]);
      if (isOver || key === shown || body.querySelector("select:focus")) return;
      shown = key;
      body.replaceChildren(el("h1", {}, "Diagnosis and repair"), ...found.flatMap((one) => [repairCard(one.repair, load), diagnosisCard(one)]).filter(Boolean));
    } catch (error) {
      runs = false;
      if (!isOver && shown !== error.message) body.replaceChildren(el("h1", {}, "Diagnosis and repair"), el("p", { class: "empty" }, error.message));
      shown = error.message;
    }
  }
  let timer = 0;
  const again = async () => {
    if (document.visibilityState === "visible") await load();
    if (!isOver) timer = setTimeout(again, runs ? 2000 : 15000); // It may be started later.
  };
  again();
  return () => { isOver = true; clearTimeout(timer); };
}

function diagnosisCard(one) {
  return el("section", { class: "card" }, el("h2", {}, one.diagnoser), el("p", {}, sentence(one.text, isKnown)),
    one.suspects.length ? [el("div", { class: "scroll" }, causes(one)), table([["suspect"], ["where"], ["now"]], one.suspects.map((suspect) => [
      el("span", {}, suspect.component, " ", el("span", { class: `chip ${suspect.is_certain ? "ill" : "odd"}` }, suspect.is_certain ? "faulty" : "perhaps faulty")),
      suspect.address ? actorLink(suspect.address) : "", suspect.now.replaceAll("`", "")]))] : el("p", { class: "empty" }, `None of ${one.components} components is suspected.`),
    one.candidates.length > 1 ? [el("h2", {}, "Explanations"), one.candidates.map((candidate) => el("p", {}, el("progress", { max: 1, value: candidate.probability, "aria-label": `${(candidate.probability * 100).toFixed(0)} percent` }), ` ${(candidate.probability * 100).toFixed(0)} %  ${candidate.bad.join(" and ") || "nobody"}`))] : null,
    one.why.trim() ? el("details", { open: one.suspects.length > 0 }, el("summary", {}, "Why"), el("pre", {}, one.why)) : null,
    one.next_best.length ? el("p", {}, `Look next at: ${one.next_best.map((each) => `${each.atom} (${each.gain_bits.toFixed(2)} bits)`).join(", ")}`) : null,
    one.refused.map((each) => el("p", { class: "faint" }, `Not understood: ${each}`)));
}

function repairCard(repair, load) {
  if (!repair) return el("section", { class: "card" }, el("h2", {}, "Repair"), el("p", { class: "empty" }, "No repair runs: the diagnosis only tells."));
  const stance = el("select", { "aria-label": "How far repair goes", "data-verb": "repair-set", disabled: session.role !== "operate", onchange: async () => { await order("repair-set", [], { words: [stance.value] }); load(); } },
    ["off", "advise", "ask", "on"].map((name) => el("option", { value: name, selected: name === repair.stance }, name)));
  const deny = async () => {
    const why = el("input", { type: "text", class: "grow", "aria-label": "Why", placeholder: "why" });
    const said = await dialog(`Deny the plan of case ${repair.waiting}`, el("div", { class: "bar" }, why), "Deny", { isHarm: true, read: () => why.value.trim() || "an operator said no" });
    if (said) { await order("repair-deny", [], { words: [repair.waiting, said] }); load(); }
  };
  const waiting = repair.waiting ? el("div", { class: "card trouble odd" }, el("h3", {}, `The plan of case ${repair.waiting} waits for a yes`),
    repair.stories.filter((one) => one.case === repair.waiting).flatMap((one) => one.entries.slice(-3).map((entry) => el("p", {}, sentence(entry.text, isKnown)))),
    session.role === "operate" ? el("div", { class: "bar" }, orderButton("repair-approve", [], { words: [repair.waiting], isMain: true, after: load }), el("button", { type: "button", class: "harm", "data-verb": "repair-deny", onclick: deny }, "Deny…")) : null) : null;
  const lists = [["given up", repair.given_up], ["denied", repair.denied]].filter(([, names]) => names.length);
  return el("section", { class: "card" }, el("h2", {}, "Repair"), waiting,
    el("p", {}, "Repair goes as far as ", stance, `: ${repair.cases} cases, ${repair.useless} plans did not help.`),
    lists.length ? el("div", {}, lists.map(([name, names]) => el("p", {}, `${name}: ${names.join(", ")}`)), orderButton("repair-retry", [], { after: load })) : null,
    [...repair.stories].reverse().slice(0, 6).map((one, at) => el("details", { open: at === 0 }, el("summary", {}, `Case ${one.case}, since ${clock(one.entries[0].time)}`), el("div", { class: "scroll" }, story(one.entries)),
      table([["at", "time"], ["what"]], one.entries.map((entry) => [clock(entry.time), sentence(entry.text, isKnown)])))));
}
