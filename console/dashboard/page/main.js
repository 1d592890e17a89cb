// The page: who one is, which view is shown, and what stands at its head.

import { note } from "./acting.js";
import { actorView } from "./actor.js";
import { changesView } from "./changes.js";
import { diagnosisView } from "./diagnosis_view.js";
import { el, plural } from "./dom.js";
import { eventsView } from "./event_list.js";
import { firstView } from "./first.js";
import { lettersView } from "./letters.js";
import { connect, live } from "./live.js";
import { metricsView } from "./plots.js";
import { logIn, logOut, session, whoAmI } from "./server.js";

const VIEWS = [
  ["", "Overview", firstView], ["diagnosis", "Diagnosis", diagnosisView], ["letters", "Messages", lettersView],
  ["events", "Events", eventsView], ["changes", "Changes", changesView], ["metrics", "Metrics", metricsView],
];
const main = document.getElementById("main");
let end = null, disconnect = null, wantsSearch = false, hasShown = false;

function where() {
  const [path, more = ""] = location.hash.replace(/^#\/?/, "").split("?");
  const [view, ...parts] = path.split("/");
  return { view, path: "/" + parts.map(decodeURIComponent).join("/"), more };
}

function show() {
  const { view, path, more } = where();
  end?.();
  end = null;
  main.className = "";
  main.scrollTop = 0;
  document.getElementById("ask").close();
  try {
    if (view === "actor") end = actorView(main, path, more);
    else end = (VIEWS.find(([name]) => name === view) || VIEWS[0])[2](main, more);
  } catch (error) {
    if (!(error instanceof URIError)) throw error;
    main.replaceChildren(el("p", { class: "empty" }, "There is no such page."));
  }
  for (const link of document.querySelectorAll("#views a")) {
    if (link.dataset.view === view) { link.setAttribute("aria-current", "page"); link.scrollIntoView({ block: "nearest", inline: "nearest" }); } else link.removeAttribute("aria-current");
  }
  seek();
  if (document.activeElement === document.body && hasShown) main.focus({ preventScroll: true }); // Tab goes on from here.
  hasShown = true;
  document.title = view === "actor" ? `${path} · holdfast` : `${live.system || "holdfast"} · holdfast`;
}

function head() {
  const bad = live.troubles.filter((one) => one.grade !== "news"), isIll = bad.some((one) => one.grade === "ill");
  const dot = document.getElementById("state");
  const isUnsure = !live.isConnected || live.problem || !live.isJudged;
  const state = isUnsure ? "" : isIll ? "ill" : bad.length ? "odd" : "well";
  dot.className = `dot ${state}`;
  dot.setAttribute("aria-label", { ill: "something has to be done", odd: "something is worth a look", well: "all is well" }[state] || "not connected");
  document.getElementById("system").textContent = live.system ? `/${live.system}` : "holdfast";
  const acts = bad.length ? (bad.length === 1 ? "1 needs attention" : `${bad.length} need attention`) : isUnsure ? "…" : "all well";
  const summary = live.rows.size ? `${plural(live.rows.size, "actor")}, ${acts}` : "";
  const box = document.getElementById("summary");
  if (box.textContent !== summary) box.textContent = summary;
  const problem = document.getElementById("problem");
  problem.hidden = live.isConnected && !live.problem;
  const text = live.isConnected ? `The system does not answer: ${live.problem}` : "The dashboard does not answer: what is shown is how it was. Trying again…";
  if (problem.textContent !== text) problem.textContent = text;
  const count = document.getElementById("put-aside");
  if (count) count.textContent = live.quarantine.length ? ` ${live.quarantine.length}` : "";
  if (where().view !== "actor") document.title = `${bad.length ? `(${bad.length}) ` : ""}${live.system || "holdfast"} · holdfast`;
}

function navigation() {
  document.getElementById("views").replaceChildren(
    ...VIEWS.map(([name, label]) => el("a", { href: `#/${name}`, "data-view": name }, label, name === "letters" ? el("span", { class: "count", id: "put-aside" }) : null)),
    el("a", { href: "#/", title: `You may ${session.role === "operate" ? "look and change" : "look only"}.`, onclick: async (event) => { event.preventDefault(); end?.(); end = null; disconnect(); await logOut(); location.reload(); } }, "Log out"));
}

function theme(is) {
  if (is) document.documentElement.dataset.theme = is; else delete document.documentElement.dataset.theme;
}

function isDark() {
  return (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
}

function begin() {
  navigation();
  disconnect ??= connect();
  window.addEventListener("hashchange", show);
  for (const kind of ["troubles", "connection", "rows"]) live.addEventListener(kind, head);
  show();
}

function login(text = "") {
  end?.();
  end = null;
  const field = el("input", { type: "password", id: "token", autocomplete: "off", required: true, "aria-describedby": "why" });
  const why = el("p", { id: "why", class: text ? null : "faint", role: "status" }, text || "It was printed by `holdfast dashboard`, or is in the file that the program names.");
  const form = el("form", { class: "login card", onsubmit: async (event) => {
    event.preventDefault();
    try { await logIn(field.value.trim()); location.reload(); } catch (error) { why.textContent = error.message; why.className = ""; field.select(); }
  } }, el("h1", {}, "Log in"), el("label", { for: "token" }, "Token"), field, why, el("button", { class: "main" }, "Log in"));
  main.replaceChildren(form);
  field.focus();
}

async function start() {
  theme(localStorage.getItem("holdfast-theme"));
  document.getElementById("theme").addEventListener("click", () => {
    const is = isDark() ? "light" : "dark";
    localStorage.setItem("holdfast-theme", is);
    theme(is);
  });
  const given = /^#token=(.+)$/.exec(location.hash);
  if (given) history.replaceState(null, "", `${location.pathname}#/`); // The token stays in no history.
  try {
    if (given) await logIn(decodeURIComponent(given[1])); else await whoAmI();
  } catch (error) {
    login(given || error.status !== 401 ? error.message : "");
    return;
  }
  window.addEventListener("loggedout", () => login("Log in again: the program began anew, or it was long ago."));
  document.addEventListener("keydown", keys);
  begin();
}

function seek() {
  if (wantsSearch) document.getElementById("search")?.focus();
  wantsSearch = false;
}

function keys(event) {
  const isTyping = /^(INPUT|TEXTAREA|SELECT)$/.test(event.target.tagName) || document.getElementById("ask").open;
  if (isTyping || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "/") {
    event.preventDefault();
    wantsSearch = true;
    if (where().view === "") seek(); else location.hash = "#/";
  } else if (event.key === "Escape" && where().view === "actor") location.hash = "#/";
}

window.addEventListener("unhandledrejection", (event) => note(String(event.reason?.message || event.reason), true));
start();
