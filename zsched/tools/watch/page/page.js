// Shows what /api/live tells. Text of others only ever becomes text: nothing here parses HTML.
"use strict";

const KEPT_S = 900;
const LONGEST_S = 3600;
const MOST_EVENTS = 200;
const SILENT_MS = 20000;  // the server pings every 15 s
const state = { now: null, points: new Map(), moves: [], events: [], explained: new Map(), open: new Set(), token: "", isCut: false };
const byName = (object) => new Map(Object.entries(object));  // by name: an object has a "constructor" of its own
const byId = (id) => document.getElementById(id);

// --- elements --------------------------------------------------------------------------------------------------------

function made(space, tag, attributes, children) {
  const element = space ? document.createElementNS(space, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (typeof value === "function") element.addEventListener(name, value);
    else if (value !== null && value !== false) element.setAttribute(name, value);
  }
  for (const child of children.flat()) if (child !== null) element.append(child);
  return element;
}
const h = (tag, attributes, ...children) => made("", tag, attributes, children);
const s = (tag, attributes, ...children) => made("http://www.w3.org/2000/svg", tag, attributes, children);

function fill(id, ...children) {
  const place = byId(id);
  const [top, left] = [place.scrollTop, place.scrollLeft];
  place.replaceChildren(...children.flat());
  [place.scrollTop, place.scrollLeft] = [top, left];
}

// --- words -----------------------------------------------------------------------------------------------------------

function span(seconds) {
  if (seconds === null || seconds === undefined) return "-";
  if (seconds < 9.95) return `${Math.max(seconds, 0).toFixed(1)} s`;
  const whole = Math.round(seconds);
  for (const [unit, smaller, big, small] of [["d", "h", 86400, 3600], ["h", "m", 3600, 60], ["m", "s", 60, 1]])
    if (whole >= big) return `${Math.floor(whole / big)}${unit}${String(Math.floor((whole % big) / small)).padStart(2, "0")}${smaller}`;
  return `${whole} s`;
}
function size(bytes) {
  let value = bytes;
  for (const unit of ["B", "KiB", "MiB", "GiB"]) {
    if (value < 1000 || unit === "GiB") return `${unit === "B" ? value.toFixed(0) : value.toFixed(1)} ${unit}`;
    value /= 1024;
  }
}
const number = (value, digits) => (value === null || value === undefined ? "-" : value.toFixed(digits));
const percent = (ratio) => (ratio === null || ratio === undefined ? "-" : `${Math.round(ratio * 100)} %`);
const clock = (at) => new Date(at * 1000).toLocaleTimeString([], { hour12: false });
const seconds = (at) => (typeof at === "number" ? at : Date.parse(at) / 1000);
const shown = (epoch) => epoch % 4294967296;  // counted from 1, as the other verbs do
const level = (ratio) => (ratio === null || ratio === undefined ? "dim" : ratio >= 0.85 ? "bad" : ratio >= 0.6 ? "warn" : "good");
const radio = (dbm) => (dbm >= -65 ? "good" : dbm >= -75 ? "warn" : "bad");
const colour = (node) => Math.max(state.now.status.nodes.findIndex((one) => one.name === node), 0) % 8;
const roomOf = (id, least, most) => Math.min(Math.max(byId(id).clientWidth, least), most);  // pixels, so that letters keep their size
const stateWord = (node) => {
  const kinds = (node.flags || []).map((flag) => flag.kind);
  if (node.state !== "alive" || node.draining) return node.state === "alive" ? "draining" : node.state;
  return kinds.includes("leave") ? "leaving" : kinds.includes("drain") ? "drained" : kinds.length ? "no new" : "alive";
};
const isAway = (node) => node.state === "gone" || node.state === "unknown";

// --- topology --------------------------------------------------------------------------------------------------------

function topology(status) {
  const sides = [status.nodes.filter((one) => one.kind === "robot"), status.nodes.filter((one) => one.kind !== "robot")];
  const room = roomOf("topology", 300, 640), high = 62, step = 78;
  const wide = Math.min(Math.round(room * 0.36), 190), gap = room - 2 * wide, isNarrow = wide < 150;
  const rows = Math.max(sides[0].length, sides[1].length, 1);
  const width = room, height = rows * step + 4;
  const places = new Map();
  sides.forEach((side, column) => side.forEach((node, row) => {
    places.set(node.name, { x: column * (wide + gap), y: (row + (rows - side.length) / 2) * step + 4, column });
  }));
  const wires = [], labels = [], boxes = [];
  const robots = sides[0].map((one) => one.name);
  for (const node of status.nodes) for (const link of node.links) {
    const [from, to] = [places.get(node.name), places.get(link.peer)];
    if (!to || link.rssi_dbm === null) continue;
    const isAcross = from.column !== to.column;
    const start = [from.x + (from.column ? 0 : wide), from.y + high / 2];
    const end = isAcross ? [to.x + (to.column ? 0 : wide), to.y + high / 2] : [from.x + wide + 24, (from.y + to.y + high) / 2];
    wires.push(s("line", { class: `wire ${radio(link.rssi_dbm)}`, x1: start[0], y1: start[1], x2: end[0], y2: end[1] }));
    const share = 0.22 + 0.2 * (Math.max(robots.indexOf(node.name), 0) % 3);
    const [x, y] = [start[0] + (end[0] - start[0]) * share, start[1] + (end[1] - start[1]) * share];
    labels.push(s("rect", { class: "label", x: x - 13, y: y - 8, width: 26, height: 14, rx: 3 }),
      s("text", { class: "small", x, y: y + 3, "text-anchor": "middle" }, link.rssi_dbm.toFixed(0)));
  }
  for (const node of status.nodes) {
    const { x, y } = places.get(node.name);
    const owned = status.tasks.filter((task) => task.owner === node.name).map((task) => task.name);
    const common = node.links.find((link) => link.peer === null);
    const way = !common ? "" : common.rssi_dbm === null ? common.source : `${common.rssi_dbm.toFixed(0)}${isNarrow ? "" : " dBm"}`;
    const stateName = stateWord(node);
    const mark = node.state === "alive" ? (stateName === "alive" ? "good" : "warn") : node.state === "suspect" ? "warn" : "bad";
    const bar = wide - 24;
    boxes.push(s("g", { transform: `translate(${x} ${y})` },
      s("rect", { class: `box${owned.length ? " owner" : ""}${isAway(node) ? " away" : ""}`, width: wide, height: high, rx: 8 }),
      s("circle", { class: `fill-${mark}`, cx: 14, cy: 15, r: 4.5 }),
      s("text", { class: "strong", x: 24, y: 19 }, node.name + (node.name === status.node ? " *" : "")),
      s("text", { class: "dim small", x: wide - 10, y: 19, "text-anchor": "end" }, stateName === "alive" ? way : stateName),
      s("rect", { class: "track", x: 12, y: 28, width: bar, height: 6, rx: 3 }),
      node.cpu_ratio === null ? null : s("rect", { class: `fill-${isAway(node) ? "dim" : level(node.cpu_ratio)}`, x: 12, y: 28, width: bar * Math.min(node.cpu_ratio, 1), height: 6, rx: 3 }),
      isNarrow && owned.length ? null : s("text", { class: "dim small", x: 12, y: 51 }, `CPU ${percent(node.cpu_ratio)}`),
      s("text", { class: "strong", x: wide - 10, y: 52, "text-anchor": "end" }, owned.length > 2 ? `${owned.length} tasks` : owned.join(", "))));
  }
  return s("svg", { viewBox: `-1 0 ${width + 2} ${height}`, role: "img", "aria-label": "nodes, their links in dBm, and which tasks they own" }, wires, labels, boxes);
}

// --- tasks -----------------------------------------------------------------------------------------------------------

function window_() {
  const to = Math.max(state.now.answered_at, 1);
  const first = Math.min(...[...state.points.values()].map((points) => (points.length ? points[0].at : to)), to - 60);
  return { from: Math.max(first, to - KEPT_S), to };
}
function longer(view) {
  const first = Math.min(...state.moves.map((move) => seconds(move.at)), view.from);
  return { from: Math.max(first - Math.min(30, (view.to - first) / 20), view.to - LONGEST_S), to: view.to };
}
const across = (at, view, width) => ((at - view.from) / (view.to - view.from)) * width;

function chart(task, view) {
  const width = roomOf("tasks", 280, 2000), left = 22, height = 120, points = (state.points.get(task.name) || []).filter((point) => point.at >= view.from);
  const y = (value) => height - 6 - Math.min(Math.max(value, 0), 1.1) / 1.1 * (height - 12);
  const at = (when) => left + across(when, view, width - left);
  const parts = [0, 0.5, 1].map((value) => [s("line", { class: "grid", x1: left, x2: width, y1: y(value), y2: y(value) }),
    s("text", { class: "dim small", x: left - 5, y: y(value) + 3, "text-anchor": "end" }, String(value))]).flat();
  for (const move of state.moves.filter((one) => !one.is_known && one.task === task.name && seconds(one.at) > view.from)) {
    const x = at(seconds(move.at));
    parts.push(s("line", { class: "move", x1: x, x2: x, y1: 0, y2: height }));
  }
  for (const name of task.candidates) {
    let path = "", isDown = false;
    for (const point of points) {
      const value = point.totals.get(name);
      if (value === undefined) { isDown = false; continue; }
      path += `${isDown ? "L" : "M"}${at(point.at).toFixed(1)} ${y(value).toFixed(1)}`;
      isDown = true;
    }
    if (path) parts.push(s("path", { class: `curve s${colour(name)}${name === task.owner ? " thick" : ""}`, d: path }));
  }
  parts.push(s("text", { class: "dim small", x: width - 2, y: height + 9, "text-anchor": "end" }, `last ${span(view.to - view.from)}`));
  return s("svg", { viewBox: `0 0 ${width} ${height + 12}`, role: "img", "aria-label": `worth for ${task.name} over time` }, parts);
}

function taskCard(task, view) {
  const points = state.points.get(task.name) || [], newest = points.length ? points[points.length - 1].totals : new Map();
  const vetoed = byName(task.decision ? task.decision.vetoed : {});
  const legend = task.candidates.map((name) => h("span", {},
    s("svg", { viewBox: "0 0 10 10" }, s("rect", { class: `f${colour(name)}`, width: 10, height: 10, rx: 2 })),
    `${name}${name === task.owner ? " *" : ""} `, newest.has(name) ? newest.get(name).toFixed(3) : h("span", { class: "dim" }, vetoed.get(name) || "-")));
  const isFine = task.owner !== null && task.owner_state === "alive";
  const isOpen = state.open.has(task.name);
  return h("div", { class: "task" },
    h("header", {}, h("h3", {}, task.name),
      h("span", { class: isFine ? "" : "bad" }, task.owner === null ? "nobody owns it" : `${task.owner}${isFine ? "" : ` is ${task.owner_state}`}`),
      h("span", { class: "dim" }, `epoch ${shown(task.epoch)} · ${task.phase} · for ${span(task.since_s)}`),
      h("button", { type: "button", click: () => toggle(task.name), "aria-expanded": String(isOpen) }, isOpen ? "close" : "explain")),
    points.length ? chart(task, view) : h("p", { class: "dim" }, "no judgement here: edges decide nothing, so ask a robot (--node)"),
    h("div", { class: "legend" }, legend),
    isOpen ? explained(state.explained.get(task.name)) : null);
}

function explained(body) {
  if (!body) return h("p", { class: "explain dim" }, "asking ...");
  if (body.error) return h("p", { class: "explain bad" }, body.error);
  const rows = body.candidates.map((one) => h("tr", {}, h("td", {}, one.node),
    h("td", { class: "number" }, number(one.joint, 4)), h("td", { class: "number" }, number(one.unkept, 4)), h("td", { class: "number" }, number(one.bonus, 3)),
    h("td", { class: "number" }, number(one.total, 4)),
    h("td", { class: "text bad" }, one.why_not || "")));
  const titles = ["candidate", "mean", "not kept", "bonus", "worth", ""];
  return h("div", { class: "explain" },
    h("p", {}, `${body.outcome} ${body.candidate || ""}: ${body.reason}`),
    h("p", { class: "dim" }, `as ${body.node} judged it ${span(body.age_s)} ago · a move costs ${number(body.price_s, 1)} s · ${body.heard.length} robots heard, ${body.needed} needed`),
    h("div", { class: "scroll" }, h("table", {}, h("tr", {}, titles.map((title, at) => h("th", { class: at && at < 5 ? "number" : "" }, title))), rows)),
    body.changes.map((change) => h("p", {}, change)));
}

async function toggle(task) {
  if (state.open.delete(task)) { draw(); return; }
  state.open.add(task);
  draw();
  await explain(task);
}

async function explain(task) {
  try {
    const answer = await fetch(`/api/explain/${encodeURIComponent(task)}`, { headers: bearer() });
    state.explained.set(task, await answer.json());
  } catch (error) {
    state.explained.set(task, { error: String(error) });
  }
  if (state.now) draw();
}

// --- epochs, streams, nodes, events ----------------------------------------------------------------------------------

function epochs(status, view) {
  const width = roomOf("epochs", 280, 2000), row = 26, name = width > 500 ? 120 : 76, moves = state.moves;
  const parts = [];
  status.tasks.forEach((task, at) => {
    const y = at * row;
    parts.push(s("text", { x: 0, y: y + 17 }, task.name.slice(0, width > 500 ? 16 : 10)));
    const own = moves.filter((move) => move.task === task.name).sort((a, b) => seconds(a.at) - seconds(b.at));
    const spans = own.map((move, index) => ({ owner: move.to, epoch: move.epoch, from: seconds(move.at), to: index + 1 < own.length ? seconds(own[index + 1].at) : view.to }));
    if (!own.length && task.owner) spans.push({ owner: task.owner, epoch: task.epoch, from: view.from, to: view.to });
    for (const one of spans.filter((each) => each.owner && each.to > view.from)) {
      const x = name + across(Math.max(one.from, view.from), view, width - name), end = name + across(one.to, view, width - name);
      parts.push(s("rect", { class: `f${colour(one.owner)}`, x, y: y + 3, width: Math.max(end - x - 1, 2), height: row - 6, rx: 3 },
        s("title", {}, `epoch ${shown(one.epoch)}: ${one.owner}`)));
      if (end - x > 90) parts.push(s("text", { class: "on", x: x + 7, y: y + 17 }, `${one.owner} · ${shown(one.epoch)}`));
    }
  });
  const y = status.tasks.length * row + 14;
  parts.push(s("text", { class: "dim small", x: name, y }, clock(view.from)), s("text", { class: "dim small", x: width, y, "text-anchor": "end" }, clock(view.to)));
  return s("svg", { viewBox: `0 0 ${width} ${y + 4}`, role: "img", "aria-label": "owners of each task over time" }, parts);
}

function moveLine(move) {
  const took = move.switched_s === null ? "" : ` (streams switched in ${(move.switched_s * 1000).toFixed(0)} ms)`;
  return h("li", {}, h("time", {}, clock(seconds(move.at))), h("b", {}, move.task),
    ` epoch ${shown(move.epoch)}: ${move.from || "nobody"} → ${move.to || "nobody"}: ${move.reason}${took}`);
}

function table(titles, rows, numbers) {
  const kind = (at) => (numbers.includes(at) ? "number" : "");
  return h("table", {}, h("thead", {}, h("tr", {}, titles.map((title, at) => h("th", { class: kind(at) }, title)))),
    h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, at) => h("td", { class: kind(at) }, cell))))));
}

function streams(status) {
  const all = status.tasks.flatMap((task) => task.streams);
  if (!all.length) return h("p", { class: "dim" }, `${status.node} has no streams`);
  return table(["stream", "per s", "speed", "in flight", "behind its input", "dropped", "from", "to"], all.map((one) => {
    const drops = Object.entries(one.drops).map(([reason, count]) => `${count} ${reason}`).join(", ");
    return [one.stream, number(one.hz, 1), one.bytes_per_s === null || one.bytes_per_s === undefined ? "-" : `${size(one.bytes_per_s)}/s`,
      one.in_flight === null || one.in_flight === undefined ? "-" : String(one.in_flight),
      one.answer_s === null || one.answer_s === undefined ? "-" : `${(one.answer_s * 1000).toFixed(0)} ms`, drops || "-", one.from_expr || "-", one.to_expr || "-"];
  }), [1, 2, 3, 4]);
}

function nodes(status) {
  return table(["node", "kind", "state", "age", "CPU", "cores", "memory", "link", "workers"], status.nodes.map((node) => {
    const common = node.links.find((link) => link.peer === null) || node.links[0];
    const way = !common ? "-" : common.rssi_dbm === null ? common.source : `${common.rssi_dbm.toFixed(0)} dBm`;
    return [node.name + (node.name === status.node ? " *" : ""), node.kind, stateWord(node), span(node.age_s), percent(node.cpu_ratio),
      node.cpu_cores === null ? "-" : `${number(node.cpu_used_cores, 2)} of ${node.cpu_cores}`, percent(node.memory_ratio), way,
      node.workers.map((worker) => `${worker.task} ${worker.state}`).join(", ") || "-"];
  }), [3, 4, 5, 6]);
}

const eventLine = (event) => h("li", {}, h("time", {}, clock(event.at)), h("span", { class: "dim" }, `${event.stage} `), event.task ? h("b", {}, `${event.task} `) : null, event.text);

function draw() {
  const status = state.now.status;
  if (!status) return;
  const view = window_();
  const isSilent = Boolean(state.now.why) || state.isCut;
  document.title = `${isSilent || state.now.degraded.length ? "! " : ""}${status.fleet} · zsched`;
  byId("fleet").textContent = `fleet ${status.fleet}`;
  byId("who").textContent = `${status.node} (${status.kind}) · quorum ${status.quorum.alive} of ${status.quorum.electors}, needs ${status.quorum.needed} · up ${span(status.up_s)} · zsched ${status.version}`;
  const health = byId("health"), away = status.nodes.filter(isAway).length, troubles = state.now.problems.length;
  health.textContent = isSilent ? "no answer" : state.now.degraded.length ? "DEGRADED" : troubles ? `${troubles} problem${troubles > 1 ? "s" : ""}` : away ? `ok, ${away} away` : "ok";
  health.className = isSilent || state.now.degraded.length ? "bad" : troubles || away ? "warn" : "good";
  fill("problems", state.now.problems.map((text) => h("li", {}, text)));
  document.querySelector("main").hidden = false;
  fill("topology", topology(status));
  fill("tasks", status.tasks.map((task) => taskCard(task, view)));
  fill("epochs", epochs(status, longer(view)));
  fill("moves", state.moves.filter((one) => !one.is_known).slice(-12).reverse().map(moveLine));
  fill("streams", streams(status));
  fill("nodes", nodes(status));
  fill("events", state.events.slice().reverse().map(eventLine));
}

// --- live ------------------------------------------------------------------------------------------------------------

const takers = {
  past(body) {
    state.points = byName(body.points);
    for (const points of state.points.values()) for (const point of points) point.totals = byName(point.totals);
    state.moves = body.moves;
    state.events = body.events.slice(-MOST_EVENTS);
  },
  now(body) {
    state.now = body;
    state.isCut = false;
    for (const [task, point] of Object.entries(body.points)) {
      point.totals = byName(point.totals);
      const kept = state.points.get(task) || [];
      state.points.set(task, kept);
      if (kept.length && kept[kept.length - 1].at - point.at > 0.1) kept.length = 0; // the clock there was set back
      if (!kept.length || point.at > kept[kept.length - 1].at + 0.1) kept.push(point);
      while (kept.length > KEPT_S) kept.shift();
    }
    const since = body.answered_at ? `no answer since ${clock(body.answered_at)}` : "nothing heard yet";
    tell(body.why ? `${since}: ${body.why}` : body.answered_at ? `live, ${clock(body.answered_at)}` : since, Boolean(body.why));
    for (const task of state.open) explain(task);
    draw();
  },
  log(body) {
    state.moves = body.moves;
    state.events = state.events.concat(body.events).slice(-MOST_EVENTS);
    if (state.now) draw();
  },
};

function tell(text, isBad) {
  byId("link").textContent = text;
  byId("link").className = isBad ? "bad" : "";
}

// What is shown is old from now on, and its badge must not look fresh.
function cut(text) {
  tell(text, true);
  state.isCut = true;
  if (state.now) draw();
}

const bearer = () => (state.token ? { Authorization: `Bearer ${state.token}` } : {});

// A machine without power, or a tunnel that hangs, says nothing, and ends nothing either.
async function listen() {
  const silence = new AbortController();
  let heardAt = Date.now();
  const watch = setInterval(() => {
    if (Date.now() - heardAt > SILENT_MS) silence.abort(new Error(`no word for ${SILENT_MS / 1000} s`));
  }, 1000);
  try {
    await hear(silence.signal, () => { heardAt = Date.now(); });
  } finally {
    clearInterval(watch);
  }
}

async function hear(signal, heard) {
  const answer = await fetch("/api/live", { headers: bearer(), cache: "no-store", signal });
  byId("ask").hidden = answer.status !== 401;
  if (!answer.ok) {
    const body = await answer.json().catch(() => ({}));
    throw Object.assign(new Error(body.error || `status ${answer.status}`), { status: answer.status });
  }
  const reader = answer.body.getReader(), decoder = new TextDecoder();
  for (let text = "";;) {
    const { value, done } = await reader.read();
    if (done) return;
    heard();
    const blocks = (text + decoder.decode(value, { stream: true })).split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const [, kind, data] = /^event: (\w+)\ndata: (.*)$/.exec(block) || [];
      if (Object.hasOwn(takers, kind)) takers[kind](JSON.parse(data));
    }
  }
}

async function live() {
  for (;;) {
    try {
      await listen();
      cut("the connection ended; connecting again");
    } catch (error) {
      cut(error.status === 401 ? "this server wants a token" : `no connection: ${error.message}; trying again`);
      if (error.status === 401) return;
    }
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
}

byId("ask").addEventListener("submit", (event) => {
  event.preventDefault();
  state.token = byId("token").value.trim();
  sessionStorage.setItem("token", state.token);
  byId("ask").hidden = true;
  tell("connecting ...", false);
  live();
});

const given = /^#token=([!-~]+)$/.exec(location.hash);
state.token = given ? given[1] : sessionStorage.getItem("token") || "";
if (given) {  // the part behind # is never sent; now it is not shown, either
  sessionStorage.setItem("token", state.token);
  history.replaceState(null, "", "/");
}
live();
