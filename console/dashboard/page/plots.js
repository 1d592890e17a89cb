// A few numbers over the last five minutes, as long as the page is open; a monitoring system keeps more.

import { spark } from "./charts.js";
import { el, keyed } from "./dom.js";
import { live } from "./live.js";

const shown = (one) => { const value = one.points.at(-1) ?? 0; return `${value.toFixed(one.unit === "MB" || one.unit === "%" ? 1 : 0)}${one.unit ? ` ${one.unit}` : ""}`; };

export function metricsView(main) {
  const counts = el("div", { class: "plots" }), memory = el("div", { class: "plots" }), cpu = el("div", { class: "plots" });
  main.replaceChildren(el("h1", {}, "Metrics"), el("p", { class: "faint" }, "Since this page is open, five minutes at most, a point each second. What is to be kept for longer belongs into Prometheus: `holdfast.console.telemetry.metrics`."),
    counts, el("h2", {}, "Memory of the processes"), memory, el("h2", {}, "Processor, of one"), cpu);
  const draw = () => {
    const all = [...live.series.values()], isProcess = (letter) => (one) => one.key[0] === letter && /^\d+$/.test(one.key.slice(1));
    put(counts, all.filter((one) => !isProcess("m")(one) && !isProcess("c")(one)));
    put(memory, all.filter(isProcess("m")));
    put(cpu, all.filter(isProcess("c")), 100);
  };
  live.addEventListener("series", draw);
  draw();
  return () => live.removeEventListener("series", draw);
}

function put(parent, series, top = null) {
  keyed(parent, series, (one) => one.key, () => el("div", { class: "card plot" }, el("h2", {}, el("span"), el("b")), el("div")), (element, one) => {
    element.querySelector("span").textContent = element.querySelector("span").title = one.label;
    element.querySelector("b").textContent = shown(one);
    element.lastElementChild.replaceChildren(spark(one.points, { top: top && Math.max(top, ...one.points) }));
  });
}
