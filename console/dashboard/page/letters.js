// Messages that nobody handled: those in quarantine, which can be tried again, and dead letters.

import { orderButton } from "./acting.js";
import { actorLink, clock, el, moment, table } from "./dom.js";
import { eventTable } from "./event_list.js";
import { live } from "./live.js";
import { ask, question } from "./server.js";

export function lettersView(main) {
  const aside = el("div"), dead = el("div");
  main.replaceChildren(el("h1", {}, "Messages"), el("section", { class: "card" }, el("h2", {}, "In quarantine"),
    el("p", { class: "faint" }, "They have ended their actor's process again and again, and were put aside. Mend the cause; then have them handled as if they had come now, or drop them."), aside),
    el("section", { class: "card" }, el("h2", {}, "Dead letters"), dead));
  let isOver = false, shown = "";
  const draw = () => {
    const key = JSON.stringify(live.quarantine);
    if (key === shown) return;
    shown = key;
    aside.replaceChildren(table([["since", "time"], ["whose"], ["message"], ["from"], ["deaths", "num"], [""]], live.quarantine.map((one) => [
      el("span", { title: moment(one.since) }, clock(one.since)), actorLink(one.address), el("span", {}, `${one.id} ${one.message}`, one.payload ? el("div", { class: "faint" }, one.payload) : null),
      one.sender ? actorLink(one.sender) : "", String(one.attempts),
      el("div", { class: "bar" }, orderButton("quarantine-retry", [one.address], { words: [one.id] }), orderButton("quarantine-drop", [one.address], { words: [one.id] }))]), "Nothing is in quarantine."));
  };
  let last = -1;
  const load = async () => {
    const newest = live.events.filter((one) => one.kind === "DeadLetter").at(-1)?.number ?? -1;
    if (newest === last && dead.children.length) return;
    last = newest;
    try {
      const page = await ask({ ask: "history", question: question({ kinds: ["DeadLetter"], limit: 100 }) });
      if (!isOver) dead.replaceChildren(page.events.length ? eventTable(page.events.reverse()) : el("p", { class: "empty" }, "There are none."));
    } catch (error) { dead.replaceChildren(el("p", { class: "empty" }, error.message)); }
  };
  live.addEventListener("troubles", draw);
  live.addEventListener("events", load);
  draw();
  load();
  return () => { isOver = true; live.removeEventListener("troubles", draw); live.removeEventListener("events", load); };
}
