// The first page: what is ill, why, and what to do; and under it the tree.

import { LABELS, orderButton } from "./acting.js";
import { actorLink, actorHref, el, keyed, plural, sentence } from "./dom.js";
import { isKnown, live } from "./live.js";
import { session } from "./server.js";
import { Tree } from "./tree.js";

export const GRADES = { ill: "act", odd: "look", news: "news" };

export function firstView(main) {
  main.className = "first";
  const worst = el("div"), newsList = el("div"), newsTitle = el("summary");
  const news = el("details", { class: "news" }, newsTitle, newsList);
  const well = el("p", { class: "well-note" });
  const attention = el("section", { id: "attention", "aria-label": "What needs attention" }, well, worst, news);
  const tree = new Tree();
  main.replaceChildren(attention, tree.bar, tree.element);
  const draw = () => {
    const bad = live.troubles.filter((one) => one.grade !== "news"), told = live.troubles.filter((one) => one.grade === "news");
    const isReady = live.rows.size > 0 && live.isJudged && live.isConnected && !live.problem;
    well.hidden = bad.length > 0;
    well.classList.toggle("faint", !isReady);
    well.textContent = isReady ? `All is well, as far as is known: ${plural(live.rows.size, "actor")}, nothing to do.` : "Waiting for the system…";
    show(worst, arranged(bad));
    news.hidden = !told.length;
    newsTitle.textContent = `News of the last ten minutes: ${plural(told.length, "actor")}, nothing to do`;
    show(newsList, told);
    if (told.length && !bad.length && told.length <= 2) news.dataset.opened || ((news.open = true), (news.dataset.opened = "yes"));
  };
  for (const kind of ["troubles", "connection"]) live.addEventListener(kind, draw);
  draw();
  const first = tree.firstFit() || live.tops[0]?.path;
  if (first) tree.goTo(first);
  return () => { tree.end(); for (const kind of ["troubles", "connection"]) live.removeEventListener(kind, draw); };
}

// Those whose cause is with another one stand behind that one.
export function arranged(troubles) {
  const byPath = new Map(troubles.map((one) => [one.address, one])), done = new Set(), ordered = [];
  const put = (one, level) => {
    if (done.has(one.address)) return;
    done.add(one.address);
    ordered.push({ ...one, level });
    for (const other of troubles) if ((other.leads || []).includes(one.address)) put(other, level + 1);
  };
  for (const one of troubles) if (!(one.leads || []).some((path) => byPath.has(path))) put(one, 0);
  for (const one of troubles) put(one, 0); // They wait for each other in a circle.
  return ordered;
}

export function show(parent, troubles) {
  keyed(parent, troubles, (one) => one.address, make, update);
}

function make(one) {
  const title = el("h3", {}, actorLink(one.address), " ", el("span", { class: "chip" }), el("span", { class: "faint lead" }));
  return el("article", {}, title, el("div", { class: "said" }), el("div", { class: "todos" }), el("div", { class: "bar" }));
}

function update(element, one) {
  element.className = `card trouble ${one.grade}${one.level ? " led" : ""}`;
  const chip = element.querySelector(".chip");
  chip.className = `chip ${one.grade === "news" ? "" : one.grade}`;
  chip.textContent = GRADES[one.grade];
  element.querySelector(".lead").textContent = one.level ? ` because of ${one.leads[0]}, it seems` : "";
  texts(element.querySelector(".said"), one.sentences, null);
  texts(element.querySelector(".todos"), one.level ? [] : one.advice || [], "todo");
  const bar = element.querySelector(".bar"), orders = one.level ? [] : one.orders || [];
  const put = live.quarantine.filter((message) => message.address === one.address);
  const key = JSON.stringify([orders, one.case || 0, put.map((message) => message.id), session.role]);
  if (bar.dataset.orders === key) return; // What somebody is about to press stays where it is.
  bar.dataset.orders = key;
  bar.replaceChildren(...orders.flatMap((verb) => buttons(verb, one, put)).filter(Boolean), el("a", { href: one.view ? `#/${one.view}` : actorHref(one.address), class: "look" }, one.view ? `See the ${one.view}` : "Look closer"));
}

function buttons(verb, one, put) {
  const path = one.address;
  if (verb === "repair-approve") return [orderButton(verb, [], { words: [one.case], isMain: true, label: `Approve case ${one.case}` })];
  if (verb === "state") return session.sees_state ? [el("a", { class: "button", "data-verb": "state", href: `${actorHref(path)}?state` }, LABELS.state)] : [];
  if (!verb.startsWith("quarantine")) return [orderButton(verb, [path])];
  return put.slice(0, 3).map((message) => orderButton(verb, [path], { words: [message.id], label: put.length > 1 ? `${LABELS[verb]} ${message.id}` : LABELS[verb] }));
}

// Sentences change with each second that is in them; the elements stay.
function texts(parent, sentences, kind) {
  while (parent.children.length > sentences.length) parent.lastElementChild.remove();
  sentences.forEach((text, at) => {
    let one = parent.children[at];
    if (!one) parent.append((one = el("p", { class: kind })));
    if (one.dataset.text === text) return;
    one.dataset.text = text;
    one.replaceChildren(...sentence(text, isKnown));
  });
}
