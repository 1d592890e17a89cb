// Elements, and texts that are put into them as text: nothing that comes from an actor is ever read as HTML.

export function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "class") made.className = value;
    else if (name === "value") made.value = value;
    else made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children.flat(9).filter((one) => one !== null && one !== undefined && one !== false));
  return made;
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(tag, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, String(value));
  made.append(...children.flat(9).filter((one) => one !== null && one !== undefined && one !== false));
  return made;
}

export const actorHref = (path) => "#/actor" + path.split("/").map(encodeURIComponent).join("/");
export const actorLink = (path, text = path) => el("a", { href: actorHref(path) }, text);
export const nameOf = (path) => path.slice(path.lastIndexOf("/") + 1);
export const aboveOf = (path) => path.slice(0, path.lastIndexOf("/"));
export const shortKind = (kind) => kind.slice(kind.lastIndexOf(".") + 1);

// A sentence in which the addresses of known actors lead to them.
export function sentence(text, isKnown) {
  const parts = [];
  let from = 0;
  for (const found of text.matchAll(/\/[^\s,;:()`'"]+/g)) {
    let path = found[0].replace(/[.]+$/, "");
    if (!isKnown(path)) continue;
    parts.push(text.slice(from, found.index), actorLink(path));
    from = found.index + path.length;
  }
  parts.push(text.slice(from));
  return parts;
}

// Has an element's children be these, keeping those that are there: focus and scroll stay where they are.
export function keyed(parent, items, keyOf, make, update) {
  const known = new Map([...parent.children].map((one) => [one.dataset.key, one]));
  let before = null;
  for (const item of items) {
    const key = keyOf(item);
    let one = known.get(key);
    if (one) known.delete(key);
    else { one = make(item); one.dataset.key = key; }
    update(one, item);
    const next = before ? before.nextElementSibling : parent.firstElementChild;
    if (next !== one) parent.insertBefore(one, next);
    before = one;
  }
  for (const gone of known.values()) gone.remove();
}

export function moment(seconds) {
  const at = new Date(seconds * 1000), two = (n) => String(n).padStart(2, "0");
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${clock(seconds)}`;
}

export function clock(seconds) {
  const at = new Date(seconds * 1000), two = (n) => String(n).padStart(2, "0");
  return `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}.${String(at.getMilliseconds()).padStart(3, "0")}`;
}

export function bytes(count) {
  return count >= 1e9 ? `${(count / 1e9).toFixed(2)} GB` : `${(count / 1e6).toFixed(count < 1e7 ? 1 : 0)} MB`;
}

export function seconds(count) {
  if (count < 10) return `${count.toFixed(1)} s`;
  if (count < 120) return `${Math.round(count)} s`;
  return count < 7200 ? `${Math.round(count / 60)} min` : `${(count / 3600).toFixed(1)} h`;
}

export const plural = (count, one, many = one + "s") => `${count} ${count === 1 ? one : many}`;

export function table(heads, rows, empty = "There is nothing.") {
  if (!rows.length) return el("p", { class: "empty" }, empty);
  const head = el("tr", {}, heads.map(([name, kind]) => el("th", { class: kind, scope: "col" }, name)));
  const body = rows.map((row) => el("tr", {}, row.map((cell, at) => el("td", { class: heads[at][1] }, cell))));
  return el("div", { class: "scroll" }, el("table", {}, el("thead", {}, head), el("tbody", {}, body)));
}
