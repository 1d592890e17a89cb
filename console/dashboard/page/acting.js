// Orders: buttons, the questions before something is lost, and what has become of them.

import { el } from "./dom.js";
import { act, session } from "./server.js";

export const LABELS = {
  suspend: "Suspend", resume: "Resume", restart: "Restart", kill: "Kill the turn", stop: "Stop", start: "Start", remove: "Remove",
  checkpoint: "Save state", state: "See its state", protect: "Protect…", bind: "Bind…", unbind: "Unbind",
  "quarantine-retry": "Retry message", "quarantine-drop": "Drop message",
  "repair-approve": "Approve", "repair-deny": "Deny", "repair-retry": "Let repair try again", "repair-set": "Set",
};
export const TITLES = {
  suspend: "It handles no message until it is resumed; messages wait.",
  resume: "It handles messages again.",
  restart: "The life ends in good order, and its supervisor begins the next one; messages wait for it.",
  kill: "Ends the life in the middle of a turn that hangs; whoever asked for it hears that. Its supervisor begins the next one.",
  stop: "It ends, and keeps its spec: start brings it back. Waiting messages are handed back.",
  start: "Starts it again.",
  remove: "It ends for good, and its spec goes.",
  checkpoint: "Its state is saved now.",
};
const HARM = new Set(["kill", "stop", "remove", "quarantine-drop", "repair-deny"]);

export function note(text, isBad = false, lasts = isBad ? 15000 : 5000) {
  const one = el("div", { class: isBad ? "note ill" : "note", role: isBad ? "alert" : null }, text);
  const notes = document.getElementById("notes");
  notes.append(one);
  while (notes.children.length > 4) notes.firstElementChild.remove();
  setTimeout(() => one.remove(), lasts);
}

// A dialog; resolves to what `read` makes of it, or null.
export function dialog(title, body, yes, { isHarm = false, read = () => true } = {}) {
  const box = document.getElementById("ask");
  const before = document.activeElement;
  return new Promise((resolve) => {
    let answer = null;
    const no = el("button", { type: "button", onclick: () => box.close() }, yes ? "Cancel" : "Close");
    const go = yes && el("button", { type: "submit", class: isHarm ? "harm" : "main" }, yes);
    const form = el("form", { method: "dialog", onsubmit: (event) => { event.preventDefault(); answer = read(); box.close(); } },
      el("h2", { id: "asktitle" }, title), body, el("div", { class: "bar" }, no, go));
    box.replaceChildren(form);
    box.setAttribute("aria-labelledby", "asktitle");
    box.onclose = () => { box.replaceChildren(); before?.focus?.(); resolve(answer); };
    box.showModal();
    (box.querySelector("input, select, textarea") || no).focus(); // A hasty Enter does no harm.
  });
}

export function outcome(done) {
  return el("div", {},
    done.steps.length ? el("ol", { class: "steps" }, done.steps.map((one) => el("li", {}, one))) : null,
    difference(done.difference),
    done.lost.map((one) => el("p", {}, `! ${one}`)),
    done.said.map((one) => el("p", {}, one)),
    done.failed.map((one) => el("p", { class: "faint" }, one)));
}

export function difference(lines) {
  if (!lines.length) return null;
  return el("pre", { class: "diff" }, lines.map((line) => el("span", { class: line.startsWith("+") ? "plus" : line.startsWith("-") ? "minus" : null }, line + "\n")));
}

// Gives an order; asks in the words of the command line first, if something would be lost. Returns what was done, or null.
export async function order(verb, paths, { words = [], text = "", isDryRun = false } = {}) {
  const wanted = { verb, paths, words: words.map(String), text, is_dry_run: isDryRun };
  const title = `${(LABELS[verb] || verb).replace("…", "")} ${paths.length === 1 ? paths[0] : paths.length ? `${paths.length} actors` : ""}`.trim();
  try {
    let done = await act(wanted);
    if (done.warnings.length) {
      const yes = await dialog(title, el("ul", {}, done.warnings.map((one) => el("li", {}, one))), "Go on", { isHarm: true });
      if (!yes) return null;
      done = await act({ ...wanted, is_confirmed: true });
    }
    if (!isDryRun) note([title, ": done", ...done.said.slice(0, 3).map((one) => el("div", { class: "faint" }, one))]);
    for (const one of done.failed) note(one, true);
    return done;
  } catch (error) {
    note(`${title}: ${error.message}`, true);
    return null;
  }
}

// A button for an order; those who may only look get none.
export function orderButton(verb, paths, { words = [], label = LABELS[verb], after = null, isMain = false } = {}) {
  if (session.role !== "operate") return null;
  const button = el("button", { type: "button", class: HARM.has(verb) ? "harm" : isMain ? "main" : null, title: TITLES[verb], "data-verb": verb }, label);
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      const done = await order(verb, typeof paths === "function" ? paths() : paths, { words });
      if (done && after) await after(done);
    } finally { button.disabled = false; }
  });
  return button;
}
