// Small pictures by hand, as SVG.

import { clock, el, nameOf, seconds, shortKind, svg } from "./dom.js";

export const PHASES = ["detect", "isolate", "restart", "restore", "replay", "release"];

export function spark(points, { height = 44, width = 240, top = null } = {}) {
  const most = top ?? Math.max(...points, 1e-9), step = points.length > 1 ? width / (points.length - 1) : width;
  const y = (value) => height - 2 - (Math.max(0, value) / most) * (height - 4);
  const line = points.map((value, at) => `${at ? "L" : "M"}${(at * step).toFixed(1)} ${y(value).toFixed(1)}`).join("");
  return svg("svg", { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none", width: "100%", height, "aria-hidden": "true" },
    svg("path", { d: `${line}L${((points.length - 1) * step).toFixed(1)} ${height}L0 ${height}Z`, class: "spark-area" }),
    svg("path", { d: line, class: "spark" }));
}

// The phases of recoveries, each life a bar; the longest one is as wide as there is room.
export function recoveries(lives) {
  const shown = lives.filter((life) => Object.keys(life.phases).length);
  if (!shown.length) return null;
  const whole = (life) => Object.values(life.phases).reduce((sum, one) => sum + one, 0);
  const most = Math.max(...shown.map(whole), 1e-6), width = 520, left = 54, right = 70, high = 20;
  const rows = shown.map((life, at) => {
    let x = left;
    const bars = PHASES.filter((name) => name in life.phases).map((name) => {
      const w = (life.phases[name] / most) * (width - left - right);
      const bar = svg("rect", { x: x.toFixed(1), y: at * high + 3, width: Math.max(w, 0.5).toFixed(1), height: high - 6, class: `ph${PHASES.indexOf(name)}` }, svg("title", {}, `${name}: ${(life.phases[name] * 1000).toFixed(1)} ms`));
      x += w;
      return bar;
    });
    return [svg("text", { x: 0, y: at * high + 14 }, `life ${life.number}`), bars, svg("text", { x: x + 5, y: at * high + 14, class: "faint" }, `${(whole(life) * 1000).toFixed(1)} ms`)];
  });
  const names = PHASES.filter((name) => shown.some((life) => name in life.phases));
  return el("div", {}, svg("svg", { viewBox: `0 0 ${width} ${shown.length * high}`, width, role: "img", "aria-label": `Phases of ${shown.length} recoveries` }, rows), legend(names));
}

function legend(names) {
  return el("div", { class: "legend" }, names.map((name) => el("span", {}, svg("svg", { width: 10, height: 10 }, svg("rect", { width: 10, height: 10, class: `ph${PHASES.indexOf(name)}` })), name)));
}

// Lives on one line of time.
export function lifeLine(lives, now) {
  const known = lives.filter((life) => life.started !== null);
  if (!known.length) return null;
  const from = known[0].started, span = Math.max(now - from, 0.001), width = 720, high = 34;
  const x = (at) => ((at - from) / span) * (width - 2) + 1;
  const bars = known.map((life) => {
    const end = life.ended ?? now, isBad = life.ended !== null && !life.by;
    return svg("rect", { x: x(life.started).toFixed(1), y: 3, width: Math.max(x(end) - x(life.started), 1.5).toFixed(1), height: 14, rx: 2, class: isBad ? "life bad" : "life" },
      svg("title", {}, `life ${life.number}: ${clock(life.started)}, ${life.ended === null ? "goes on" : `ended ${clock(life.ended)}, ${life.reason}`}`));
  });
  return svg("svg", { viewBox: `0 0 ${width} ${high}`, width, role: "img", "aria-label": `${known.length} lives in ${seconds(span)}` }, bars,
    svg("text", { x: 1, y: 30, class: "faint" }, clock(from).slice(0, 8)), svg("text", { x: width - 1, y: 30, class: "faint", "text-anchor": "end" }, "now"));
}

// The replicas with their bricks, and who leads.
export function mechanism(protection, bricks) {
  const names = Object.keys(protection.replicas), order = ["before", "proceed", "server", "after", "state"];
  const wide = 220, gap = 26, width = names.length * wide + (names.length - 1) * gap, top = 62;
  let high = 0;
  const boxes = names.map((name, at) => {
    const parts = Object.entries(bricks[name] || {}).filter(([part]) => order.includes(part)).sort(([a], [b]) => order.indexOf(a) - order.indexOf(b));
    const x = at * (wide + gap), state = protection.replicas[name], height = 34 + parts.length * 26;
    high = Math.max(high, height);
    const kind = state === "leads" || state === "follows" ? "well" : state === "joining" ? "odd" : "ill";
    return svg("g", {},
      svg("path", { d: `M${width / 2} 26 L${width / 2} 38 L${x + wide / 2} 38 L${x + wide / 2} ${top}`, class: `edge ${kind === "ill" ? "ill" : ""}`, "stroke-dasharray": state === "leads" ? "none" : "4 4" }),
      svg("rect", { x: x + 1, y: top, width: wide - 2, height: height + 4, rx: 7, class: `box ${kind}` }),
      svg("text", { x: x + 12, y: top + 20, "font-weight": 600 }, `${name} ${state}`),
      parts.map(([part, name], row) => svg("g", {},
        svg("rect", { x: x + 10, y: top + 32 + row * 26, width: wide - 20, height: 20, rx: 4, class: "box" }),
        svg("text", { x: x + 18, y: top + 46 + row * 26 }, `${part}: ${shortKind(name)}`))));
  });
  const whole = protection.is_whole ? "whole" : "not whole";
  return svg("svg", { viewBox: `0 0 ${Math.max(width, 300)} ${top + high + 8}`, width: Math.max(width, 300), role: "img", "aria-label": `${protection.stack.join(" + ")}, ${whole}, epoch ${protection.epoch}, ${names.map((name) => `${name} ${protection.replicas[name]}`).join(", ")}` },
    svg("text", { x: width / 2, y: 18, "text-anchor": "middle", "font-weight": 600 }, `${protection.stack.join(" + ")}, ${whole}, epoch ${protection.epoch}`), boxes);
}

// What was seen, and whom it may come from: symptoms on the left, suspects on the right.
export function causes(one) {
  const bad = one.suspects.map((suspect) => suspect.component), high = 30, width = 760;
  const chance = (name) => one.candidates.filter((candidate) => candidate.bad.includes(name)).reduce((sum, candidate) => sum + candidate.probability, 0);
  const signs = [...one.symptoms, ...one.contradictions].slice(0, 12), rows = Math.max(signs.length, bad.length, 1);
  const y = (at, count) => ((at + 0.5) * rows * high) / Math.max(count, 1);
  const edges = signs.flatMap((sign, from) => bad.map((name, to) => {
    const isNamed = sign.includes(name);
    return svg("path", { d: `M330 ${y(from, signs.length)} C430 ${y(from, signs.length)} 430 ${y(to, bad.length)} 510 ${y(to, bad.length)}`, class: isNamed ? "edge ill" : "edge", opacity: isNamed ? 0.9 : 0.25 });
  }));
  const cut = (text, most) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);
  return svg("svg", { viewBox: `0 0 ${width} ${rows * high}`, width, role: "img", "aria-label": `${signs.length} symptoms, ${bad.length} suspects` }, edges,
    signs.map((sign, at) => svg("g", {}, svg("rect", { x: 1, y: y(at, signs.length) - 12, width: 329, height: 24, rx: 5, class: "box" }), svg("text", { x: 9, y: y(at, signs.length) + 4 }, cut(sign, 52), svg("title", {}, sign)))),
    bad.map((name, at) => svg("g", {}, svg("rect", { x: 510, y: y(at, bad.length) - 12, width: 249, height: 24, rx: 5, class: `box ${one.suspects[at].is_certain ? "ill" : "odd"}` }), svg("text", { x: 518, y: y(at, bad.length) + 4 }, cut(`${name}${chance(name) ? `  ${(100 * chance(name)).toFixed(0)} %` : ""}`, 38), svg("title", {}, name)))));
}

// A case of repair: a row for each component, and what was said of it, at its time.
export function story(entries) {
  const rows = [...new Set(entries.flatMap((entry) => (entry.components.length ? entry.components : ["the case"])))];
  const from = entries[0].time, span = Math.max(entries[entries.length - 1].time - from, 0.1), width = 760, left = 190, high = 24;
  const x = (at) => left + 8 + ((at - from) / span) * (width - left - 24);
  const kinds = { RepairBegan: "ill", GaveUp: "ill", ApprovalWanted: "odd", ActionBegan: "odd", Repaired: "well", AdviceScored: "well" };
  return svg("svg", { viewBox: `0 0 ${width} ${rows.length * high + 20}`, width, role: "img", "aria-label": `${entries.length} steps of a case in ${seconds(span)}` },
    rows.map((name, at) => [svg("text", { x: 0, y: at * high + 16 }, nameOf(name).slice(0, 28)), svg("path", { d: `M${left} ${at * high + 12}H${width}`, class: "axis" })]),
    entries.flatMap((entry) => (entry.components.length ? entry.components : ["the case"]).map((name) => svg("circle", { cx: x(entry.time).toFixed(1), cy: rows.indexOf(name) * high + 12, r: 5, class: `box ${kinds[entry.what] || ""}` }, svg("title", {}, `${seconds(entry.time - from)}: ${entry.text}`)))),
    svg("text", { x: left, y: rows.length * high + 15, class: "faint" }, "0 s"), svg("text", { x: width, y: rows.length * high + 15, class: "faint", "text-anchor": "end" }, seconds(span)));
}
