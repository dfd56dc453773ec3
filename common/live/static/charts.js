// Draws the charts with plotly. What they show is computed in `memory.js`.

import { amount, answered, incidents, queue } from "./memory.js";

/* global Plotly */

const SYMBOLS = ["circle", "diamond", "square", "triangle-up"];
const RINGS = { hedge: "circle-open", fallback: "square-open", late: "triangle-up-open" };
const BINS = 30;
const PARTS = 200; // remote answers whose parts are drawn
const AXIS_STEPS = 16; // at least, from one end of a time axis to the other
const OPTIONS = { displayModeBar: false, responsive: true };

export const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const siteNumber = (sites, site) => Math.max(0, sites.indexOf(site)) % SYMBOLS.length;
const siteColour = (sites, site) => colour(`--site-${siteNumber(sites, site)}`);
const faded = (hex, share) => hex + Math.round(share * 255).toString(16).padStart(2, "0");

// An axis of time around instants in ms. Its ends move in steps: Plotly remembers each label at each of its places.
export function timeAxis(instants) {
  if (!instants.length) return { type: "date" };
  const from = Math.min(...instants), to = Math.max(...instants);
  const step = 1000 * 2 ** Math.max(0, Math.ceil(Math.log2((to - from) / 1000 / 2 / AXIS_STEPS)));
  return { type: "date", range: [Math.floor(from / step) * step, (Math.floor(to / step) + 1) * step] };
}

// Charts change their width when a card is added next to theirs.
const resized = new ResizeObserver(entries => {
  for (const { target } of entries) if (target.data) Plotly.Plots.resize(target);
});

// A card with a heading, a chart and a sentence that says what it shows. It is made at its first use.
function card(id, title) {
  let figure = document.getElementById(id);
  if (figure === null) {
    figure = document.createElement("figure");
    figure.id = id;
    const heading = document.createElement("h2"), plot = document.createElement("div");
    heading.textContent = title;
    plot.className = "plot";
    plot.setAttribute("role", "img");
    resized.observe(plot);
    figure.append(heading, plot, document.createElement("p"));
    document.getElementById("charts").append(figure);
  }
  figure.querySelector("h2").textContent = title;
  return figure;
}

function draw(id, title, traces, layout, said) {
  const figure = card(id, title), text = colour("--text"), grid = colour("--grid");
  const axis = { gridcolor: grid, zerolinecolor: grid, linecolor: grid, automargin: true };
  figure.querySelector(".plot").setAttribute("aria-label", `${title}. ${said}`);
  figure.querySelector("p").textContent = said;
  Plotly.react(figure.querySelector(".plot"), traces, {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: text, size: 12 },
    margin: { l: 48, r: 12, t: 8, b: 36 }, dragmode: false, showlegend: traces.length > 1,
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, hovermode: "closest", ...layout,
    xaxis: { ...axis, ...layout.xaxis }, yaxis: { ...axis, rangemode: "tozero", ...layout.yaxis },
  }, OPTIONS);
}

export function remove(id) {
  const figure = document.getElementById(id);
  if (figure !== null) { resized.unobserve(figure.querySelector(".plot")); Plotly.purge(figure.querySelector(".plot")); figure.remove(); }
}

const bands = spans => spans.map(([from, to, site]) => ({
  type: "rect", xref: "x", yref: "paper", x0: from, x1: to, y0: 0, y1: 1, line: { width: 0 }, layer: "below",
  fillcolor: faded(colour("--bad"), 0.22), name: site,
}));
const lines = events => events.map(event => ({
  type: "line", xref: "x", yref: "paper", x0: event.at_s * 1000, x1: event.at_s * 1000, y0: 0, y1: 1,
  line: { dash: "dot", width: 1, color: colour("--faint") },
}));

// Size or work against seconds: what was measured, and each site's prediction with its 90 % band. `which`: says which
// tasks these are.
export function drawTimes(tasks, sites, which) {
  const traces = [];
  for (const site of sites) {
    const own = siteColour(sites, site), done = tasks.filter(task => answered(task, site));
    const known = tasks.filter(task => (task.sites[site] || {}).predicted_s != null)
      .sort((a, b) => amount(a) - amount(b));
    const banded = known.filter(task => task.sites[site].low_s !== null && task.sites[site].high_s !== null);
    traces.push({
      x: banded.map(amount), y: banded.map(task => task.sites[site].predicted_s), mode: "markers",
      name: `${site}, predicted`, marker: { symbol: "line-ew-open", size: 7, color: own },
      error_y: {
        type: "data", symmetric: false, thickness: 1.5, width: 0, color: faded(own, 0.28),
        array: banded.map(task => task.sites[site].high_s - task.sites[site].predicted_s),
        arrayminus: banded.map(task => task.sites[site].predicted_s - Math.max(0, task.sites[site].low_s)),
      },
    }, {
      x: done.map(amount), y: done.map(task => answered(task, site).seconds), mode: "markers",
      name: `${site}, measured`, marker: { symbol: SYMBOLS[siteNumber(sites, site)], size: 6, color: own },
    });
  }
  const what = tasks.some(task => task.features.work !== undefined) ? "work" : "size";
  // A site that is silent may be expected to take very long: that must not flatten everything else.
  const measured = tasks.flatMap(task => task.executions.filter(one => one.ok).map(one => one.seconds));
  const highs = sites.map(site => Math.max(0, ...tasks.map(task => (task.sites[site] || {}).high_s ?? 0)))
    .filter(high => high > 0);
  const top = 1.1 * Math.max(0, ...measured, highs.length ? Math.min(...highs) : 0);
  const cut = Math.max(0, ...highs) > top ? " Longer predictions are cut off." : "";
  draw("times", `Time by ${what}: measured, and predicted with the 90 % band`, traces,
    { xaxis: { title: { text: what } }, yaxis: { title: { text: "seconds" }, ...(top ? { range: [0, top] } : {}) } },
    `${which} Dashes with bars: each site's prediction and its 90 % band.${cut}`);
}

// When each task began, how long its caller waited, whose answer was used, and what went wrong.
export function drawHistory(tasks, sites, spans, events, which) {
  const traces = [...sites, null].map(site => {
    const own = tasks.filter(task => task.used === site);
    return {
      x: own.map(task => task.at), y: own.map(task => task.waited_s), mode: "markers",
      name: site || "no answer", text: own.map(task => task.decision.reason),
      marker: {
        symbol: site ? SYMBOLS[siteNumber(sites, site)] : "x", size: 7,
        color: site ? siteColour(sites, site) : colour("--bad"),
      },
    };
  });
  for (const [what, symbol] of Object.entries(RINGS)) {
    const own = tasks.flatMap(task => incidents(task).filter(one => one[0] === what).map(one => [task, one[1]]));
    traces.push({
      x: own.map(([task]) => task.at), y: own.map(([task]) => task.waited_s), text: own.map(([, why]) => why), mode: "markers",
      name: what, marker: { symbol, size: 13, color: colour("--text"), line: { width: 1.5 } },
    });
  }
  const out = spans.length ? ` Red: ${[...new Set(spans.map(span => span[2]))].join(", ")} silent or absent.` : "";
  draw("history", "How long each task took, by the site that answered", traces.filter(trace => trace.x.length),
    { xaxis: timeAxis([...tasks.map(task => task.at), ...spans.flatMap(span => span.slice(0, 2))]), yaxis: { title: { text: "seconds" } }, shapes: [...bands(spans), ...lines(events)] },
    `${which}${out}`);
}

// The queue of a stream, and the chunks that did not get into it.
export function drawQueue(tasks, spans) {
  const { at, seconds, others } = queue(tasks);
  if (!at.length) { remove("queue"); return; }
  const traces = [
    { x: at, y: seconds, mode: "lines", name: "queue", line: { color: colour("--site-0"), width: 1.5 } },
    { x: others.map(one => one.at), y: others.map(one => one.seconds), mode: "markers", name: "not played",
      text: others.map(one => `${one.outcome}: ${one.site}`), marker: { symbol: "x", color: colour("--bad") } },
  ];
  const empty = seconds.filter((left, i) => i > 0 && left === 0).length;
  draw("queue", "Queue of actions", traces.filter(one => one.x.length), { shapes: bands(spans), xaxis: timeAxis(at), yaxis: { title: { text: "seconds left" } } },
    `The queue was empty ${empty === 1 ? "once" : `${empty} times`}; ${others.length} ${others.length === 1 ? "chunk was" : "chunks were"} not played.`);
}

// Where tasks were sent over time.
export function drawPlaces(tasks, sites) {
  if (!tasks.length) return;
  const from = tasks[0].at, width = Math.max(1000, (tasks[tasks.length - 1].at - from) / BINS);
  const chosen = site => tasks.filter(task => task.decision.site === site || task.decision.both);
  const traces = sites.map(site => {
    const counts = new Map();
    for (const task of chosen(site)) {
      const bin = from + width * (Math.floor((task.at - from) / width) + 0.5);
      counts.set(bin, (counts.get(bin) || 0) + 1);
    }
    return { x: [...counts.keys()], y: [...counts.values()], type: "bar", name: site, width,
      marker: { color: siteColour(sites, site) } };
  });
  draw("places", "Where tasks were sent", traces,
    { barmode: "stack", xaxis: timeAxis([from, tasks[tasks.length - 1].at + width]), yaxis: { title: { text: "tasks" } } },
    sites.map(site => `${site}: ${chosen(site).length}`).join(", ") + `, of ${tasks.length} tasks.`);
}

// Where the time of remote answers went: on the link, in the queue, in the worker.
export function drawParts(tasks) {
  const done = tasks.flatMap(task => task.executions
    .filter(one => one.ok && one.site !== "onboard" && one.run_s !== null && one.network_s !== null)
    .map(one => ({ at: task.at, ...one }))).slice(-PARTS);
  if (!done.length) { remove("parts"); return; }
  const names = [["network_s", "link", "--site-2"], ["queue_s", "queue", "--site-3"], ["run_s", "run", "--site-1"]];
  const traces = names.map(([field, name, own]) => ({
    x: done.map((_, i) => i + 1 - done.length), y: done.map(one => one[field] || 0), type: "bar", name,
    marker: { color: colour(own) },
  }));
  draw("parts", "Time of remote answers: link, queue, run", traces,
    { barmode: "stack", bargap: 0, xaxis: { title: { text: "answer, 0 is the last" } }, yaxis: { title: { text: "seconds" } } },
    `The last ${done.length} remote answers.`);
}

// Round trips and queues of the sites: from the heartbeats now, and from what each task was decided with.
export function drawLink(samples, tasks, sites, spans) {
  const remote = sites.filter(site => site !== "onboard"), traces = [], queues = [];
  for (const site of remote) {
    const points = [
      ...tasks.map(task => [task.at, task.features[`${site}.round_trip_s`], task.features[`${site}.queue`]]),
      ...samples.filter(one => one.sites && one.sites[site])
        .map(one => [one.at, one.sites[site].round_trip_s, one.sites[site].queue]),
    ].filter(point => point[1] != null).sort((a, b) => a[0] - b[0]);
    queues.push(...points.map(point => point[2] || 0));
    const common = { x: points.map(point => point[0]), mode: "lines+markers", marker: { size: 3 } };
    traces.push(
      { ...common, y: points.map(point => 1000 * point[1]), name: `${site}: round trip`, line: { color: siteColour(sites, site) } },
      { ...common, y: points.map(point => point[2] || 0), name: `${site}: queue`, yaxis: "y2", line: { color: colour("--faint"), dash: "dot", shape: "hv" } });
  }
  if (!traces.some(trace => trace.x.length)) { remove("link"); return; }
  draw("link", "Link and queue, from heartbeats", traces, {
    xaxis: timeAxis(traces.flatMap(trace => trace.x)), yaxis: { title: { text: "ms" } }, shapes: bands(spans),
    yaxis2: {
      overlaying: "y", side: "right", rangemode: "tozero", title: { text: "tasks" }, showgrid: false,
      automargin: true, tickformat: "d", nticks: 4, range: [0, Math.max(4, ...queues) * 1.05],
    },
  }, "Solid: round trip. Dotted: tasks that wait at the site.");
}

// The queue and the workers of a server.
export function drawServer(samples) {
  const x = samples.map(one => one.at);
  const line = (name, values, own, dash, shape = "hv") => ({ x, y: values, mode: "lines", name, line: { color: colour(own), dash, shape } });
  draw("queue", "Queue and workers", [
    line("waiting", samples.map(one => one.server.queue_depth), "--site-3"),
    line("running", samples.map(one => one.server.running), "--site-1"),
    line("workers", samples.map(one => one.server.workers), "--faint", "dot"),
  ], { xaxis: timeAxis(x), yaxis: { title: { text: "tasks" } } }, "Since this page is open, one sample a second.");
  const statuses = [...new Set(samples.flatMap(one => Object.keys(one.server.statuses)))];
  const own = ["--site-0", "--site-1", "--site-3", "--site-2"];
  const counted = (i, status) => samples[i].server.statuses[status] || 0;
  const rate = status => samples.map((_, i) => i === 0 ? null
    : (counted(i, status) - counted(i - 1, status)) / Math.max(0.001, (x[i] - x[i - 1]) / 1000));
  draw("rates", "Requests a second, by outcome",
    statuses.map((status, i) => line(status, rate(status), own[i % own.length], i < own.length ? "solid" : "dash", "vh")), // a rate is that of the second before
    { xaxis: timeAxis(x), yaxis: { title: { text: "a second" } } },
    statuses.length ? `Outcomes: ${statuses.join(", ")}.` : "No request yet.");
}
