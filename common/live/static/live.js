// The page: asks for looks, remembers them, and shows how things are now, or were at the time of the slider.

import { moreBudget, onePlace, predictionsGood, serverBusy, serverOrLink, whichRobot, whyThere } from "./answers.js";
import { drawHistory, drawLink, drawParts, drawPlaces, drawQueue, drawServer, drawTimes, siteNumber } from "./charts.js";
import { amount, incidents, judged, Memory, ms, outages, percent, sinceStart, sum, thinned, total } from "./memory.js";
import { follow, run, unpacked } from "./stream.js";

const STEPS = 1000; // of the slider
const ROWS = 30; // decisions in the table
const ROWS_OF_INCIDENTS = 500;
const NAMES = { robot: "robot", server: "server", run: "run", report: "" };

const memory = new Memory();
const by = id => document.getElementById(id);
let chosen = null, followed = true, until = Infinity, due = false;

const clock = at => new Date(at).toLocaleTimeString([], { hourCycle: "h23" }); // as in the charts
const say = (id, text) => { if (by(id).textContent !== text) by(id).textContent = text; };

function sitesOf(tasks, sample) {
  const names = new Set(["onboard", ...Object.keys((sample && sample.sites) || {})]);
  for (const task of tasks) {
    Object.keys(task.sites).forEach(site => names.add(site));
    task.executions.forEach(one => names.add(one.site));
  }
  return [...names];
}

// How the sites are now; at another time, or for a trace, how the last task found them.
function conditions(tasks, sample, sites) {
  if (followed && sample && sample.sites) return sample.sites;
  const task = tasks[tasks.length - 1], found = {};
  for (const site of sites) {
    const own = { absent: task && !(site in task.sites) ? "it was not there for this task" : null };
    for (const [name, value] of Object.entries(task ? task.features : {})) {
      if (name.startsWith(`${site}.`)) own[name.slice(site.length + 1)] = value;
    }
    found[site] = own;
  }
  return found;
}

function showSites(conditions, sites) {
  const cards = sites.filter(site => conditions[site]).map(site => {
    const one = conditions[site], box = document.createElement("div"), heading = document.createElement("h2");
    box.dataset.site = site;
    box.style.setProperty("--own", `var(--site-${siteNumber(sites, site)})`);
    heading.textContent = site;
    const state = document.createElement("p"), facts = document.createElement("p");
    const out = one.absent || (one.silent ? "silent: heartbeats are not answered" : null);
    state.textContent = out || "there";
    state.className = out ? "bad" : "";
    const shares = [
      one.round_trip_s == null ? null : `round trip ${ms(one.round_trip_s)}`,
      one.queue == null ? null : `${one.queue} waiting`,
      one.wait_s ? `wait ${ms(one.wait_s)}` : null,
      site === "onboard" ? (one.load == null ? null : `load ${percent(one.load)}`)
        : (one.server_load == null ? null : `load of the server ${percent(one.server_load)}`),
      one.capacity == null ? null : `${percent(one.capacity)} of a CPU`,
    ];
    facts.textContent = shares.filter(text => text !== null).join(", ");
    box.append(heading, state, facts);
    return box;
  });
  by("sites").replaceChildren(...cards);
  by("sites").hidden = !cards.length;
}

function answer(id, [verdict, figures]) {
  say(`answer-${id}`, verdict);
  say(`answer-${id}-figures`, figures);
}

function fill(body, rows, long) {
  body.replaceChildren(...rows.map(values => {
    const row = document.createElement("tr");
    for (const [i, value] of values.entries()) {
      const cell = document.createElement("td");
      cell.textContent = value;
      if (i === long) cell.className = "long";
      row.append(cell);
    }
    return row;
  }));
}

function showDecisions(tasks) {
  fill(by("decision-rows"), tasks.slice(-ROWS).reverse().map(task => {
    const outlook = task.sites[task.decision.site];
    return [clock(task.at), task.i, shortly(amount(task)), placeOf(task), task.decision.reason, outlook ? ms(outlook.predicted_s) : "unknown", ms(task.waited_s), task.used || "none"];
  }), 4);
  const why = memory.source === "report" ? "the file holds the last tasks" : "the robot is busy";
  const few = memory.leftOut ? ` (${why}: ${memory.leftOut} tasks were left out)` : "";
  say("decisions-title", `Decisions, the latest first${few}`);
  by("decisions").hidden = false;
}

function showIncidents(tasks, spans) {
  const rows = tasks.flatMap(task => incidents(task).map(([what, why]) => [task.at, what, task.i, why]));
  rows.push(...spans.map(([from, to, site]) => [from, "outage", "", `${site} was silent or absent, until ${clock(to)}`]));
  rows.sort((a, b) => b[0] - a[0]);
  fill(by("incident-rows"), rows.slice(0, ROWS_OF_INCIDENTS).map(([at, ...row]) => [clock(at), ...row]), 3);
  const counts = [...new Set(rows.map(row => row[1]))].map(what => `${what} ${rows.filter(row => row[1] === what).length}`);
  say("incidents-title", `What went wrong, the latest first: ${counts.join(", ") || "nothing"}`);
  by("incidents").hidden = false;
}

// How well each site was predicted, how many of its runs failed, and how good its answers were.
function showCalibration(tasks, sites) {
  const tested = judged(tasks).sites, some = number => number ?? "unknown";
  fill(by("calibration-rows"), sites.map(site => {
    const runs = tasks.flatMap(task => task.executions.filter(one => one.site === site)), { count, inside, below, above, error } = tested[site] || {};
    const good = runs.filter(one => one.ok), used = tasks.filter(task => task.used === site).map(task => task.sites[site]?.quality);
    const share = part => count ? percent(part / count) : "unknown";
    return [site, runs.length, good.length, good.length ? ms(sum(good.map(one => one.seconds)) / good.length) : "unknown", share(below), share(inside), share(above),
      count ? percent(error) : "unknown", used.some(one => one != null) ? (sum(used) / used.length).toFixed(3) : "no variants"];
  }));
  by("calibration").hidden = !tasks.length;
}

function showTasks() {
  const tasks = memory.tasks(chosen, until), samples = memory.samplesUntil(until), sample = samples[samples.length - 1];
  const sites = sitesOf(tasks, sample), events = memory.events.filter(one => one.at_s * 1000 <= until);
  const from = tasks.length ? tasks[0].at : 0, recent = samples.filter(one => one.at >= from);
  const spans = outages(recent, tasks);
  const now = conditions(tasks, sample, sites);
  showSites(now, sites);
  const absent = Object.entries((followed && sample && sample.sites) || {}).map(([site, one]) => [site, one.absent]);
  answer("why", whyThere(tasks, sites, spans, Object.fromEntries(absent)));
  answer("part", serverOrLink(tasks));
  answer("predictions", predictionsGood(tasks));
  answer("budget", moreBudget(tasks, followed && sample ? sample.budget : null));
  answer("place", onePlace(tasks, sites));
  showDecisions(tasks);
  showIncidents(tasks, spans);
  showCalibration(tasks, sites);
  const drawn = thinned(tasks), which = drawn.length < tasks.length ? `${drawn.length} of ${tasks.length} tasks.` : `The last ${tasks.length} tasks.`;
  drawTimes(drawn, sites, which);
  drawHistory(drawn, sites, spans, events.filter(one => one.at_s * 1000 >= from), which);
  drawQueue(tasks, spans);
  drawPlaces(tasks, sites);
  drawParts(tasks);
  drawLink(recent, drawn, sites, spans);
}

const placeOf = task => task.decision.both ? "all sites" : task.decision.site;
const shortly = number => number === 0 ? "0" : Number(number.toPrecision(3)).toLocaleString();

// What there is to say of a server where requests run together, or are refused as too late.
function together(server) {
  const runs = total(server, "offboard_server_run_requests_count"), late = total(server, "offboard_server_too_late_requests_total");
  const mean = shortly(total(server, "offboard_server_run_requests_sum") / runs);
  const held = ms(total(server, "offboard_server_held_seconds_sum") / runs);
  return [...(runs ? [`Requests in a run: ${mean}, held for ${held}, in the mean`] : []),
    ...(late ? [`Refused as too late: ${late}`] : [])];
}

function showServer() {
  const samples = memory.samplesUntil(until), server = samples[samples.length - 1].server;
  const { robots, seconds } = sinceStart(samples), all = sum(robots.map(one => one.run_s));
  const mean = (one, field) => one.tasks ? ms(one[field] / one.tasks) : "none yet";
  fill(by("robot-rows"), robots.map(one => [one.robot, all ? percent(one.run_s / all) : "none yet", one.tasks, one.waiting,
    mean(one, "queue_s"), mean(one, "run_s"), one.refused]));
  say("robots-title", `Robots, in the last ${Math.round(seconds)} s`);
  by("robots").hidden = by("answer-load-box").hidden = false;
  for (const id of ["answer-why", "answer-predictions", "answer-budget", "answer-place"]) by(id).parentElement.hidden = true;
  answer("load", whichRobot(samples));
  answer("part", serverBusy(samples));
  const state = server.draining ? "stopping" : server.ready ? "ready" : "warming up";
  const facts = [`State: ${state}, up for ${Math.round(server.uptime_s)} s`,
    `Load by other programs: ${percent(total(server, "offboard_server_other_load_ratio"))}`,
    `Refused handshakes: ${total(server, "offboard_server_refused_handshakes_total")}`,
    `Dropped messages: ${total(server, "offboard_server_dropped_messages_total")}`,
    `Robots cut off: ${total(server, "offboard_server_cut_off_connections_total")}`,
    `Workers replaced: ${total(server, "offboard_server_worker_restarts_total")}`, ...together(server)];
  by("figures").replaceChildren(...facts.map(text => Object.assign(document.createElement("p"), { textContent: text })));
  by("figures").hidden = false;
  drawServer(samples);
}

function showControls() {
  const span = memory.span(), keys = [...memory.kinds.keys()];
  const select = by("group");
  if (select.options.length !== keys.length) {
    select.replaceChildren(...keys.map(key => new Option(key, key)));
  }
  chosen = keys.includes(chosen) ? chosen : memory.latest;
  select.value = chosen;
  select.parentElement.hidden = !keys.length;
  by("controls").hidden = span === null;
  if (span === null) return;
  if (followed) until = Infinity;
  const shown = Math.min(until, span[1]);
  if (followed) by("until").value = STEPS;
  say("until-text", clock(shown));
  by("until").setAttribute("aria-valuetext", clock(shown));
  by("follow").setAttribute("aria-pressed", followed);
}

function show() {
  due = false;
  if (document.hidden || memory.source === null) return;
  if (by("source")) say("source", `${NAMES[memory.source]}${memory.over ? ", ended" : ""}`);
  showControls();
  by("answers").hidden = false;
  if (memory.source === "server") showServer();
  else showTasks();
}

function showSoon() {
  if (!due) { due = true; requestAnimationFrame(show); }
}

by("group").onchange = () => { chosen = by("group").value; showSoon(); };
by("follow").onclick = () => { followed = true; showSoon(); };
by("until").oninput = () => {
  const span = memory.span(), share = by("until").value / STEPS;
  followed = share === 1;
  until = followed ? Infinity : span[0] + share * (span[1] - span[0]);
  showSoon();
};
document.onvisibilitychange = showSoon;
matchMedia("(prefers-color-scheme: dark)").onchange = showSoon;

const inFile = await unpacked("packed-look");
if (inFile === null) {
  follow("live/looks", look => { memory.add(look); showSoon(); }, (state, text) => {
    by("state").dataset.state = state;
    say("state", text);
  });
} else {
  await run(await unpacked("packed-plotly"));
  memory.add(JSON.parse(inFile));
  const [from, to] = memory.span() ?? [0, 0];
  say("state", `${new Date(from).toLocaleString([], { hourCycle: "h23" })} to ${clock(to)}`);
  by("follow").hidden = true;
  showSoon();
}
