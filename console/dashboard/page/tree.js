// The supervision tree: all rows are data, and only those that are to be seen are elements.

import { actorHref, aboveOf, bytes, el, seconds, shortKind } from "./dom.js";
import { live, onScreen, ownProcess, turnSeconds } from "./live.js";
import { seek } from "./server.js";

const HEIGHT = 28, BEYOND = 8, MANY = 400;
const open = new Map(); // What somebody has opened or closed by hand, by path: it stays while the page does.
let lastAt = "", lastSearch = "";

export const heat = (value, steps) => steps.filter((step) => value >= step).length;
export const gravity = (state) => (state === "running" ? "" : state === "silent" ? "ill" : "odd");

export class Tree {
  constructor() {
    this.flat = []; this.places = new Map(); this.pool = []; this.at = lastAt; this.fits = null; this.built = -1; this.ticket = 0;
    this.search = el("input", { type: "search", id: "search", class: "grow", value: lastSearch, spellcheck: "false",
      placeholder: "Search, or a pattern: /app/**[queued>100]   ( / )", "aria-label": "Search actors by name, class or pattern" });
    this.told = el("span", { class: "faint num", role: "status" });
    this.space = el("div", { class: "space", role: "presentation" });
    this.box = el("div", { class: "tree", role: "tree", tabindex: "0", "aria-label": "Supervision tree" }, this.space);
    const head = ["actor:who", "class:kind", "state:st", "queued:num qu", "restarts:num re", "cpu:num cpu", "memory:num mb", "more:more"];
    this.element = el("div", { class: "treebox" },
      el("div", { class: "rowhead", "aria-hidden": "true" }, head.map((one) => el("span", { class: one.split(":")[1] }, one.split(":")[0]))), this.box);
    this.bar = el("div", { class: "bar" }, this.search,
      el("button", { type: "button", onclick: () => this.openAll(true) }, "Expand"),
      el("button", { type: "button", onclick: () => this.openAll(false) }, "Collapse"), this.told);
    this.box.addEventListener("scroll", () => this.drawSoon(), { passive: true });
    this.box.addEventListener("keydown", (event) => this.key(event));
    this.box.addEventListener("click", (event) => this.click(event));
    this.search.addEventListener("input", () => this.filter());
    this.search.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === "ArrowDown") { event.preventDefault(); this.box.focus(); this.goTo(this.firstFit()); }
      if (event.key === "Escape") { this.search.value = ""; this.filter(); this.box.focus(); }
    });
    this.sizes = new ResizeObserver(() => this.draw());
    this.sizes.observe(this.box);
    this.onRows = () => this.refresh();
    live.addEventListener("rows", this.onRows);
    this.timer = setInterval(() => this.draw(), 1000); // Turns go on, and nothing else tells of that.
    if (lastSearch) this.filter();
    else this.refresh();
  }

  end() {
    live.removeEventListener("rows", this.onRows);
    clearInterval(this.timer);
    this.sizes.disconnect();
    onScreen([]);
  }

  isOpen(row) {
    if (this.fits) return true;
    return open.get(row.path) ?? (live.rows.size <= MANY || row.depth < 1);
  }

  // The rows of the tree as it is opened, or of those that fit and who is above them.
  build() {
    const flat = [], stack = [...live.tops].reverse(), shown = this.fits && this.withAbove();
    while (stack.length) {
      const row = stack.pop();
      if (shown && !shown.has(row.path)) continue;
      flat.push(row);
      if (row.kids.length && this.isOpen(row)) for (let at = row.kids.length - 1; at >= 0; at -= 1) stack.push(row.kids[at]);
    }
    this.flat = flat;
    this.places = new Map(flat.map((row, at) => [row.path, at]));
    this.built = live.structure;
    this.space.style.height = `${flat.length * HEIGHT}px`;
    if (!this.places.has(this.at)) this.at = this.nearest(this.at);
    const fits = this.fits ? `${this.fits.size} of ` : "";
    this.told.textContent = `${fits}${live.rows.size} actors`;
  }

  withAbove() {
    const shown = new Set();
    for (let path of this.fits) for (; path && !shown.has(path); path = aboveOf(path)) shown.add(path);
    return shown;
  }

  nearest(path) {
    for (; path; path = aboveOf(path)) if (this.places.has(path)) return path;
    return this.flat[0]?.path || "";
  }

  refresh() {
    if (this.fits && this.searched && this.built !== live.structure) { this.filter(); return; }
    if (this.built !== live.structure) this.build();
    this.draw();
  }

  drawSoon() {
    if (this.isWaiting) return;
    this.isWaiting = true;
    requestAnimationFrame(() => { this.isWaiting = false; this.draw(); });
  }

  draw() {
    const top = this.box.scrollTop, room = this.box.clientHeight;
    const first = Math.max(0, Math.floor(top / HEIGHT) - BEYOND);
    const count = Math.min(this.flat.length - first, Math.min(190, Math.ceil(room / HEIGHT) + 2 * BEYOND));
    while (this.pool.length < count) { const one = makeRow(); this.pool.push(one); this.space.append(one.element); }
    for (let at = 0; at < this.pool.length; at += 1) {
      const one = this.pool[at];
      if (at >= count) { set(one, "hidden", true, () => { one.element.hidden = true; }); continue; }
      set(one, "hidden", false, () => { one.element.hidden = false; });
      this.fill(one, this.flat[first + at], first + at);
    }
    const marked = this.places.has(this.at) ? this.places.get(this.at) - first : -1;
    const id = marked >= 0 && marked < count ? this.pool[marked].element.id : "";
    if (id) this.box.setAttribute("aria-activedescendant", id); else this.box.removeAttribute("aria-activedescendant");
    onScreen(this.flat.slice(first, first + count).map((row) => row.path));
  }

  fill(one, row, at) {
    const isOpen = row.kids.length ? this.isOpen(row) : null, process = ownProcess(row);
    const turn = turnSeconds(row);
    set(one, "y", at, () => { one.element.style.transform = `translateY(${at * HEIGHT}px)`; });
    set(one, "path", row.path, () => { one.element.dataset.path = row.path; one.link.href = actorHref(row.path); one.link.title = row.path; });
    set(one, "name", row.depth ? row.name : row.path, (text) => { one.link.textContent = text; });
    set(one, "depth", row.depth, () => { one.who.style.paddingLeft = `${Math.min(row.depth, 12) * 14}px`; one.element.setAttribute("aria-level", row.depth + 1); });
    set(one, "open", isOpen, () => {
      one.twist.textContent = isOpen === null ? "" : isOpen ? "▾" : "▸";
      if (isOpen === null) one.element.removeAttribute("aria-expanded"); else one.element.setAttribute("aria-expanded", isOpen);
    });
    set(one, "at", row.path === this.at, (is) => { one.element.classList.toggle("at", is); one.element.setAttribute("aria-selected", is); });
    set(one, "fit", Boolean(this.fits?.has(row.path)), (is) => one.element.classList.toggle("fit", is));
    set(one, "kind", row.kind, () => { one.kind.textContent = shortKind(row.kind); one.kind.title = row.kind; });
    const hangs = turn >= 1 && !row.rests;
    set(one, "state", hangs && row.state === "running" ? "in a turn" : row.state, (text) => { one.state.textContent = text; });
    set(one, "grave", hangs ? (turn >= 5 ? "ill" : "odd") : gravity(row.state), (grave) => { one.state.className = `st ${grave}`; });
    heated(one, "queued", row.queued, [1, 10, 100, 1000]);
    heated(one, "restarts", row.restarts, [1, 2, 3, 6]);
    heated(one, "cpu", process?.cpu ?? null, [25, 50, 75, 90], (value) => `${value.toFixed(0)} %`);
    const share = process && row.allowed ? process.memory / row.allowed : 0;
    set(one, "memory", process ? bytes(process.memory) : "", (text) => { one.memory.textContent = text; });
    set(one, "mheat", share ? heat(share, [0.4, 0.5, 0.6, 0.8]) : 0, (h) => { one.memory.className = `num mb heat ${h ? `h${h}` : ""}`; });
    const more = [turn >= 1 ? `${row.rests ? "rests in " : ""}${shortKind(row.turn)} for ${seconds(turn)}` : "", row.place === "task" ? "" : row.place, row.recovery, row.mechanism.join(" + "), row.names.join(", ")];
    set(one, "more", more.filter(Boolean).join(", "), (text) => { one.more.textContent = text; one.more.title = text; });
  }

  goTo(path, isNear = false) {
    if (!this.places.has(path)) return;
    this.at = lastAt = path;
    const top = this.places.get(path) * HEIGHT, room = this.box.clientHeight;
    if (!isNear && (top < this.box.scrollTop || top + HEIGHT > this.box.scrollTop + room))
      this.box.scrollTop = top < this.box.scrollTop ? top : top + HEIGHT - room;
    this.draw();
  }

  toggle(row, isOpen) {
    if (!row.kids.length) return;
    open.set(row.path, isOpen);
    this.build();
    this.draw();
  }

  openAll(isOpen) {
    open.clear();
    for (const row of live.rows.values()) if (row.kids.length) open.set(row.path, isOpen || row.depth < 1);
    this.build();
    this.draw();
  }

  key(event) {
    const here = this.places.get(this.at) ?? 0, row = this.flat[here];
    if (!row || event.altKey || event.ctrlKey || event.metaKey) return;
    const page = Math.max(1, Math.floor(this.box.clientHeight / HEIGHT) - 1);
    const step = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -this.flat.length, End: this.flat.length }[event.key];
    if (step !== undefined) this.goTo(this.flat[Math.min(this.flat.length - 1, Math.max(0, here + step))].path);
    else if (event.key === "ArrowRight") row.kids.length && !this.isOpen(row) ? this.toggle(row, true) : row.kids.length && this.goTo(this.flat[here + 1].path);
    else if (event.key === "ArrowLeft") row.kids.length && this.isOpen(row) && !this.fits ? this.toggle(row, false) : this.goTo(aboveOf(row.path));
    else if (event.key === "Enter") location.hash = actorHref(row.path);
    else if (event.key === " ") this.toggle(row, !this.isOpen(row));
    else return;
    event.preventDefault();
  }

  click(event) {
    const element = event.target.closest(".row");
    const row = element && live.rows.get(element.dataset.path);
    if (!row) return;
    this.goTo(row.path, true);
    if (event.target.classList.contains("twist")) this.toggle(row, !this.isOpen(row));
  }

  firstFit() {
    return this.fits ? this.flat.find((row) => this.fits.has(row.path))?.path : this.at;
  }

  async filter() {
    const text = (lastSearch = this.search.value.trim()), ticket = (this.ticket += 1);
    this.search.setCustomValidity("");
    this.searched = Boolean(text);
    if (!text) this.fits = null;
    else if (/[*?[]/.test(text)) {
      try {
        const found = new Set(await seek(text));
        if (ticket !== this.ticket) return; // Somebody has typed on.
        this.fits = found;
      } catch (error) {
        if (ticket !== this.ticket) return;
        this.fits = new Set();
        this.search.setCustomValidity(error.message);
        this.build();
        this.draw();
        this.told.textContent = error.message;
        return;
      }
    } else {
      const wanted = text.toLowerCase();
      const isLike = (row) => row.path.toLowerCase().includes(wanted) || shortKind(row.kind).toLowerCase().includes(wanted) || row.names.some((name) => name.toLowerCase().includes(wanted));
      this.fits = new Set([...live.rows.values()].filter(isLike).map((row) => row.path));
    }
    this.build();
    const fit = this.firstFit();
    if (this.fits && fit) this.goTo(fit);
    this.draw();
  }
}

function set(one, name, value, put) {
  if (one.shown[name] === value) return;
  one.shown[name] = value;
  put(value);
}

function heated(one, name, value, steps, text = String) {
  set(one, name, value, () => {
    one[name].textContent = value === null || value === undefined ? "" : text(value);
    one[name].className = `num heat ${one.column[name]} h${heat(value ?? 0, steps)}`;
  });
}

let made = 0;
function makeRow() {
  const twist = el("span", { class: "twist", "aria-hidden": "true" });
  const link = el("a", { tabindex: "-1", class: "label" });
  const who = el("span", { class: "who" }, twist, link);
  const kind = el("span", { class: "kind" }), state = el("span", { class: "st" });
  const queued = el("span", { class: "num qu" }), restarts = el("span", { class: "num re" });
  const cpu = el("span", { class: "num cpu" }), memory = el("span", { class: "num mb" }), more = el("span", { class: "more faint" });
  const element = el("div", { class: "row", role: "treeitem", id: `row${(made += 1)}` }, who, kind, state, queued, restarts, cpu, memory, more);
  return { element, twist, link, who, kind, state, queued, restarts, cpu, memory, more, shown: {}, column: { queued: "qu", restarts: "re", cpu: "cpu" } };
}
