// What the page remembers of the looks, within limits, and how things were at a time.

const SHOWN = 200; // tasks of a kind that are judged and drawn; a report shows all
const KEPT_OF_A_KIND = { run: 20000, report: 20000 }; // the time slider of a run reaches back to its start
const DRAWN = 1000; // tasks of each sort in a chart; more make it slow and show nothing new
const SAMPLES = 900; // looks: a quarter of an hour
const EVENTS = 500;

const started = task => Date.parse(task.started_at);

export class Memory {
  constructor() {
    this.source = null;
    this.kinds = new Map(); // by "kind" or "robot: kind", the tasks in the order of their answers
    this.seen = new Map(); // the same keys: the ids of these tasks
    this.samples = []; // looks without their tasks
    this.events = [];
    this.over = false;
    this.leftOut = 0; // tasks of a busy robot that were not sent
    this.latest = null; // the key of the kind of the last task
  }

  add(look) {
    this.source = look.source;
    this.over = look.over;
    this.leftOut += look.left_out;
    for (const task of look.tasks) this.#addTask(task);
    this.events.push(...look.events);
    this.events.splice(0, this.events.length - EVENTS);
    this.samples.push({ ...look, tasks: [], events: [], at: look.now_s * 1000, server: look.server && totals(look.server) });
    this.samples.splice(0, this.samples.length - SAMPLES);
  }

  #addTask(task) {
    const key = task.robot ? `${task.robot}: ${task.kind}` : task.kind;
    if (!this.kinds.has(key)) { this.kinds.set(key, []); this.seen.set(key, new Set()); }
    const tasks = this.kinds.get(key), seen = this.seen.get(key);
    if (seen.has(task.id)) return; // sent again after the connection was lost
    seen.add(task.id);
    tasks.push({ ...task, at: started(task), ended: started(task) + 1000 * task.waited_s });
    this.latest = key;
    const kept = KEPT_OF_A_KIND[this.source] || SHOWN;
    for (const old of tasks.splice(0, tasks.length - kept)) seen.delete(old.id);
  }

  // The first and the last instant that is known, in ms; null if nothing is.
  span() {
    const all = [...this.kinds.values()].filter(tasks => tasks.length);
    const firsts = all.map(tasks => tasks[0].at), lasts = all.map(tasks => tasks[tasks.length - 1].ended);
    if (!KEPT_OF_A_KIND[this.source] && this.samples.length) {
      firsts.push(this.samples[0].at);
      lasts.push(this.samples[this.samples.length - 1].at);
    }
    return firsts.length ? [Math.min(...firsts), Math.max(...lasts)] : null;
  }

  // The last tasks of a kind that had ended by then; of a report all.
  tasks(key, until) {
    const all = (this.kinds.get(key) || []).filter(task => task.ended <= until);
    return this.source === "report" ? all : all.slice(-SHOWN);
  }

  samplesUntil(until) {
    return this.samples.filter(sample => sample.at <= until);
  }
}

export const median = values => {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? sorted[Math.floor(sorted.length / 2)] : null;
};

export const sum = values => values.reduce((total, one) => total + one, 0);

// What the predictors were asked with: the expected work, if sites learn times per work, else the size.
export const amount = task => task.features.work ?? (Array.isArray(task.size) ? task.size[0] : task.size);

export const ms = seconds => seconds == null ? "unknown" : seconds < 5e-6 ? "0 ms" : seconds >= 1 ? `${seconds.toFixed(2)} s` : `${(1000 * seconds).toFixed(seconds < 0.01 ? 2 : 0)} ms`;
export const percent = share => `${Math.round(100 * share)} %`;

export const answered = (task, site) => task.executions.find(one => one.site === site && one.ok);

// The other sites that a task could have used, with their outlook: [[site, outlook], ...].
export const others = (task, site) => Object.entries(task.sites)
  .filter(([name]) => name !== site && !task.features[`${name}.silent`]);

// As many tasks as a chart can show, evenly: first those in which something went wrong, then others.
export function thinned(tasks) {
  const some = all => all.filter((_, i) => i % Math.ceil(all.length / DRAWN) === 0);
  const kept = new Set([...some(tasks.filter(task => incidents(task).length)), ...some(tasks)]);
  return tasks.filter(task => kept.has(task));
}

// What did not go as the decision hoped, and why: [[what, why], ...]. A run that another answer overtook did not fail.
export function incidents(task) {
  const { site, both, second, second_after_s } = task.decision, found = [];
  const failed = task.executions.filter(one => !one.ok && !(one.error || "").startsWith("Overtaken"));
  const errors = failed.map(one => `${one.site}: ${one.error}`).join("; ");
  if (task.cancelled) found.push(["cancelled", task.happened]);
  else if (!task.used) found.push(["no answer", errors]);
  else if (!both && failed.some(one => one.site === site)) found.push(["fallback", `${errors}; answered by ${task.used}`]);
  if (!both && second_after_s > 0 && task.executions.some(one => one.site === second)) {
    found.push(["hedge", `${site} had not answered after ${ms(second_after_s)}, so ${second} started too; answered by ${task.used}`]);
  }
  const limit = task.deadline_s ?? (both ? null : task.sites[site]?.high_s);
  if (task.used && limit != null && task.waited_s > limit) {
    const { queue_s, run_s, network_s } = task.executions.find(one => one.site === task.used && one.ok) || {};
    const parts = [["link", network_s], ["queue", queue_s], ["run", run_s]].filter(([, seconds]) => seconds);
    found.push(["late", `${ms(task.waited_s)}, ${task.deadline_s == null ? "above the 90 % band, which ended at" : "after the deadline of"} ${ms(limit)}`
      + (parts.length ? `; ${task.used}: ${parts.map(([name, seconds]) => `${name} ${ms(seconds)}`).join(", ")}` : "")]);
  }
  return found;
}

// By the robot's own predictions: what each site alone would have taken per task, and what the same tasks took:
// [{site, count, alone, took}, ...]. Where a remote site is too slow, the robot gives it up and runs onboard.
export function constants(tasks, sites) {
  return sites.map(site => {
    const known = tasks.filter(task => !task.decision.both && task.sites[site]?.predicted_s != null);
    const alone = ({ sites, timeout_s }) => site === "onboard" ? sites.onboard.predicted_s
      : Math.min(sites[site].predicted_s, timeout_s + (sites.onboard?.predicted_s ?? Infinity));
    return { site, count: known.length, alone: sum(known.map(alone)) / known.length, took: sum(known.map(task => task.waited_s)) / known.length };
  }).filter(one => one.count);
}

// How many answers were inside the 90 % band of their prediction, how many below and above it, and the median of the
// relative errors: {count, inside, below, above, error, sites}; `sites` has the same for each site.
export function judged(tasks) {
  const tested = tasks.flatMap(task => task.executions.map(one => [one, task.sites[one.site]]))
    .filter(([one, outlook]) => one.ok && outlook && outlook.low_s !== null && outlook.high_s !== null);
  const judge = some => ({
    count: some.length,
    inside: some.filter(([one, { low_s, high_s }]) => low_s <= one.seconds && one.seconds <= high_s).length,
    below: some.filter(([one, { low_s }]) => one.seconds < low_s).length,
    above: some.filter(([one, { high_s }]) => one.seconds > high_s).length,
    error: median(some.map(([one, outlook]) => Math.abs(one.seconds - outlook.predicted_s) / one.seconds)),
  });
  const names = [...new Set(tested.map(([one]) => one.site))];
  return { ...judge(tested), sites: Object.fromEntries(names.map(site => [site, judge(tested.filter(([one]) => one.site === site))])) };
}

// The state of a server with sums in place of its metrics, since a quarter of an hour of all labels takes 10 MB:
// `totals` by metric, `statuses` of the requests by outcome.
function totals({ samples, ...server }) {
  const totals = {}, statuses = {};
  for (const [name, labels, value] of samples) {
    totals[name] = (totals[name] || 0) + value;
    if (name === "offboard_server_requests_total") statuses[labels.status] = (statuses[labels.status] || 0) + value;
  }
  return { ...server, totals, statuses };
}

// The sum of a metric of the server over all of its labels.
export const total = (server, name) => server.totals[name] || 0;

// What a server counted since the first look, or since it began to count again: {from, to, seconds, robots}.
// The robots are sorted by the time of workers that they used.
export function sinceStart(samples) {
  const used = look => sum(look.server.robots.map(one => one.run_s));
  const again = samples.findLastIndex((look, i) => i > 0
    && (look.server.uptime_s < samples[i - 1].server.uptime_s || used(look) < used(samples[i - 1])));
  const from = samples[Math.max(0, again)], to = samples[samples.length - 1];
  const robots = to.server.robots.map(one => {
    const before = from.server.robots.find(other => other.robot === one.robot);
    const change = name => one[name] - (before ? before[name] : 0);
    return { ...one, tasks: change("tasks"), queue_s: change("queue_s"), run_s: change("run_s"), refused: change("refused") };
  });
  return { from, to, seconds: (to.at - from.at) / 1000, robots: robots.sort((a, b) => b.run_s - a.run_s) };
}

// Where the time of the answers of other computers went: {link, queue, run}, in seconds.
export function parts(tasks) {
  const remote = tasks.flatMap(task => task.executions).filter(
    one => one.ok && one.site !== "onboard" && one.run_s !== null && one.network_s !== null);
  const total = name => sum(remote.map(one => one[name] || 0));
  return { count: remote.length, link: total("network_s"), queue: total("queue_s"), run: total("run_s") };
}

// For how many seconds the queue of a stream lasts, over time: {at, seconds}, the corners of a line; and the chunks
// that were not played: [{at, seconds, outcome, site}, ...]. `tasks`: in the order in which they ended.
export function queue(tasks) {
  const at = [], seconds = [], others = [];
  let empty = null; // when the queue ends, in ms
  for (const { chunk, ended, decision } of tasks.filter(task => task.chunk)) {
    const { outcome, hz, left, actions, dropped } = chunk;
    if (outcome !== "played") { others.push({ at: ended, seconds: left / hz, outcome, site: decision.site }); continue; }
    if (empty !== null && empty < ended) { at.push(empty); seconds.push(0); }
    at.push(ended, ended);
    seconds.push(left / hz, (actions - dropped) / hz);
    empty = ended + 1000 * (actions - dropped) / hz;
  }
  return { at, seconds, others };
}

// Spans of time, in ms, in which a site was silent or absent: [[from, to, site], ...].
export function outages(samples, tasks) {
  const points = new Map();
  const note = (site, at, out) => {
    if (!points.has(site)) points.set(site, []);
    points.get(site).push([at, out]);
  };
  for (const { at, sites } of samples) {
    for (const [site, now] of Object.entries(sites || {})) note(site, at, now.silent || now.absent !== null);
  }
  for (const site of new Set(tasks.flatMap(task => Object.keys(task.sites)))) {
    for (const task of tasks) note(site, task.at, !(site in task.sites) || Boolean(task.features[`${site}.silent`]));
  }
  const spans = [];
  for (const [site, states] of points) {
    let from = null, last = null;
    for (const [at, out] of states.sort((a, b) => a[0] - b[0])) {
      if (out && from === null) from = at;
      if (!out && from !== null) { spans.push([from, at, site]); from = null; }
      last = at;
    }
    if (from !== null) spans.push([from, last, site]);
  }
  return spans;
}
