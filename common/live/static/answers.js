// Answers the questions at the top of the page, from what `memory.js` remembers: [verdict, figures behind it].

import { constants, judged, ms, others, parts, percent, sinceStart, sum, total } from "./memory.js";

const BAND_MIN = 20; // answers, before the share inside the band is judged
const INSIDE_LEAST = 0.8, INSIDE_MOST = 0.97; // around the 90 % that a band promises
const REFUSED_LEAST = 0.02; // of the tasks that could have a second run, before a larger budget would help
const BUSY = 0.8; // share of the time that the workers run tasks, from which on they are the bottleneck

const upper = text => text[0].toUpperCase() + text.slice(1);

// `spans`: when sites were silent or absent, from `outages`; `absent`: why, by site, where it is known.
export function whyThere(tasks, sites, spans, absent) {
  const task = tasks[tasks.length - 1];
  if (!task) return ["No task yet.", ""];
  const { site, both, policy, reason } = task.decision;
  const by = task.used === site || both ? "" : `, answered by ${task.used ?? "no site"}`;
  const took = `Task ${task.i}${by}, took ${ms(task.waited_s)}.`, figures = `${took} ${reason}`;
  if (both) return ["On all sites, to learn how long each takes.", figures];
  if (policy === "pinned") return [`${upper(site)}: the call asks for this site.`, figures];
  const left = others(task, site), away = sites.filter(name => name !== site && !left.some(([other]) => other === name));
  if (away.length && !left.length) return [`${upper(site)}: ${away.map(name => awayText(name, task, spans, absent)).join(", ")}.`, figures];
  const own = task.sites[site]?.predicted_s, best = left.filter(([, one]) => one.predicted_s != null)
    .sort((a, b) => a[1].predicted_s - b[1].predicted_s)[0];
  if (own == null || !best) return [`${upper(site)}: ${reason}.`, took];
  const [name, other] = best;
  if (own > other.predicted_s) return [`${upper(site)}: the policy preferred it to ${name}, although it may take longer.`, figures];
  return [`${upper(site)}: it should take ${ms(own)} there, and ${ms(other.predicted_s)} on ${name}.`, figures];
}

function awayText(site, task, spans, absent) {
  const why = site in task.sites ? "does not answer heartbeats" : "cannot take this task";
  const span = spans.findLast(([, to, name]) => name === site && to >= task.at);
  const since = span ? `, for ${Math.round(Math.max(0, task.at - span[0]) / 1000)} s so far` : "";
  return `${site} ${why}${since}${absent[site] ? ` (${absent[site]})` : ""}`;
}

export function serverOrLink(tasks) {
  const { count, link, queue, run } = parts(tasks), all = link + queue + run;
  if (!count) return ["Unknown: no server answered.", `None of the last ${tasks.length} tasks has an answer of a server.`];
  const share = part => `${percent(part / all)} of the time of ${count} answers`;
  const verdict = link >= queue + run ? `The link: ${share(link)}.`
    : queue > run ? `The server: tasks wait in its queue for ${share(queue)}.`
      : `The server: its workers take ${share(run)}.`;
  return [verdict, `Mean: link ${ms(link / count)}, queue ${ms(queue / count)}, worker ${ms(run / count)}.`];
}

export function predictionsGood(tasks) {
  const { count, inside, error, sites } = judged(tasks), share = inside / count;
  if (!count) return ["Unknown: no prediction with a band has been tested yet.", ""];
  const figures = Object.entries(sites).map(([site, one]) =>
    `${site}: ${percent(one.inside / one.count)} of ${one.count} answers inside, median error ${percent(one.error)}`).join("; ") + ".";
  const found = `${percent(share)} of ${count} answers were inside their 90 % band, and the median error is ${percent(error)}.`;
  if (count < BAND_MIN) return [`Too early to say: ${found}`, figures];
  if (share < INSIDE_LEAST) return [`No, too sure of themselves: ${found}`, figures];
  return [`Yes${share > INSIDE_MOST ? ", and more careful than they need to be" : ""}: ${found}`, figures];
}

// A policy that hedges plans a second run for each task that could have one, unless the budget is used up.
export function moreBudget(tasks, budget) {
  const last = tasks[tasks.length - 1], regret = last && last.regret, policy = last && last.decision.policy;
  const could = tasks.filter(task => !task.decision.both && task.decision.policy === policy
    && others(task, task.decision.site).some(([, one]) => one.predicted_s != null));
  const planned = could.filter(task => task.decision.second !== null);
  const second = tasks.filter(task => task.executions.length > 1).length;
  const left = budget ? ` Left now: ${budget.duplicates.toFixed(1)} second runs${caps(budget)}.` : "";
  const figures = `${second} of the last ${tasks.length} tasks had a second run.${left} ${regret
    ? `With a second run of every task, each would be ${ms(regret.mean_s)} faster (90 %: ${ms(regret.low_s)} to ${ms(regret.high_s)}): that is the estimated regret.`
    : "The estimated regret is unknown until six probes have run."}`;
  const refused = 1 - planned.length / could.length;
  if (!tasks.length) return ["No task yet.", ""];
  if (!planned.length && policy !== "default" && !policy.split(":").includes("hedge")) return [`No: the policy ${policy} plans no second runs.`, figures];
  if (!could.length) return ["Unknown: no task could have a second run.", figures];
  if (refused < REFUSED_LEAST) return [`No: a second run was allowed for each of ${could.length} tasks, if it had been late.`, figures];
  return [`Perhaps: ${percent(refused)} of ${could.length} tasks could not have a second run.`, figures];
}

const caps = budget => ["bytes", "joules"].filter(name => budget[`${name}_left`] != null)
  .map(name => `, ${Math.round(budget[`${name}_left`])} ${name}`).join("");

export function onePlace(tasks, sites) {
  const found = constants(tasks, sites).sort((a, b) => a.alone / a.took - b.alone / b.took);
  if (found.length < 2) return ["Unknown: only one site has predictions.", ""];
  const times = ({ alone, took }) => `${ms(alone)} in place of ${ms(took)}`;
  return [`${found.map(one => `Always ${one.site}: ${(one.alone / one.took).toFixed(2)} times as long`).join(". ")}.`,
    `By the robot's own predictions, per task: ${found.map(one => `${one.site} ${times(one)} (${one.count} tasks)`).join(", ")}.`];
}

export function serverBusy(samples) {
  const { from, to, seconds, robots } = sinceStart(samples), now = to.server;
  const change = name => total(to.server, name) - total(from.server, name);
  const count = change("offboard_server_run_seconds_count"), run = change("offboard_server_run_seconds_sum");
  const wait = change("offboard_server_queue_seconds_sum"), busy = seconds ? run / (seconds * now.workers) : 0;
  const refused = sum(robots.map(one => one.refused));
  const places = Object.entries(now.places).map(([place, count]) => `${count} on ${place}`).join(", ") || "none";
  const figures = `${now.running} of ${now.workers} workers (${now.executor}; up: ${places}) are busy now, and ${now.queue_depth} tasks wait. In ${Math.round(seconds)} s ${refused} requests were refused.`;
  if (!count) return ["No task yet.", figures];
  const means = `a task waits ${ms(wait / count)} and runs ${ms(run / count)} in the mean`;
  if (busy >= BUSY || wait > run) return [`The server: its workers were busy for ${percent(busy)} of the time, and ${means}.`, figures];
  return [`Not the server: its workers were busy for ${percent(busy)} of the time, and ${means}.`, figures];
}

export function whichRobot(samples) {
  const { to, seconds, robots } = sinceStart(samples), all = sum(robots.map(one => one.run_s));
  if (!all) return ["No task yet.", ""];
  const share = run_s => percent(run_s / (seconds * to.server.workers));
  return [`${robots[0].robot}: ${percent(robots[0].run_s / all)} of the time of the workers that robots used.`,
    `All robots together used ${share(all)} of what the workers could give in ${Math.round(seconds)} s, and ${robots[0].robot} used ${share(robots[0].run_s)}.`];
}
