// The page: shows the snapshots that the server pushes, and sends what the person presses.
import { Cameras } from "./cameras.js";
import { drawCurve } from "./curve.js";
import { Films } from "./film.js";

const $ = (id) => document.getElementById(id);
const WORDS = {
  waiting: ["Ready", "Press Start (Space) for the next episode."],
  running: ["Running", "The policy drives. Success (S), Failure (F), or Pause (Space)."],
  paused: ["Paused", "The arm holds. Resume (Space) as before the pause, or end the episode: S, F or D."],
  teaching: ["You drive", "Recorded as a demonstration. Hand back (T), or end it: S, F or D."],
  labelling: ["How did it go?", "The time is up. Press Success (S), Failure (F) or Discard (D)."],
  resetting: ["Reset the scene", "Reset the scene, then press Ready (R). Mind the arm: it may be on its way home."],
  faulted: ["Fault", "Nothing moves until the robot is all right again."],
  stopped: ["Stopped", "The run is over. This page can be closed."],
};
const NAMES = {
  start: "Start", pause: "Pause", resume: "Resume", success: "Success", failure: "Failure", discard: "Discard",
  take_over: "Take over", hand_back: "Hand back", home: "Home", free: "By hand", ready: "Ready", stop: "Stop run",
};
const KEYS = { " ": "Space", escape: "Esc" };
const URGENT = ["stop", "pause"]; // everybody's, at any time
const FACTS = {
  rate_hz: ["Control rate", "Hz", 1], jitter_ms: ["Unevenness of steps", "ms", 1],
  worst_ms: ["Longest step", "ms", 0], late: ["Late steps", "", 0], limited: ["Goals changed by limits", "", 0], faults: ["Faults", "", 0], env_steps: ["Steps", "", 0], updates: ["Updates", "", 0],
  loss: ["Loss", "", 4], mean_q: ["Mean Q", "", 2], demonstrations: ["Demonstrations", "", 0],
};

// The token stays in this tab and leaves the address bar, so that it is in no history and on no shared screen.
const given = new URLSearchParams(location.search).get("token");
if (given) {
  sessionStorage.setItem("token", given);
  history.replaceState(null, "", location.pathname);
}
const token = sessionStorage.getItem("token") || "";
if (!sessionStorage.getItem("client")) {
  sessionStorage.setItem("client", [...crypto.getRandomValues(new Uint8Array(12))].map((b) => b.toString(16).padStart(2, "0")).join(""));
}
const client = sessionStorage.getItem("client");

let socket = null;
let shown = null; // the last snapshot
let shownAt = 0; // ms, when it came
let wait = 250; // ms until the next attempt to connect
let asked = 0;
let refusedTimer = 0;

export async function request(path, options = {}) {
  const headers = { "X-Token": token, "X-Client": client, ...(options.body ? { "Content-Type": "application/json" } : {}) };
  return fetch(path, { ...options, headers, signal: AbortSignal.timeout(8000) });
}

async function post(path, body) {
  try {
    const answer = await request(path, { method: "POST", body: JSON.stringify(body) });
    if (!answer.ok) refuse((await answer.json()).error);
  } catch {
    refuse("That did not reach the robot's computer.");
  }
}

function send(event) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ event, id: ++asked }));
  else post("/api/event", { event });
}

function refuse(text) {
  $("refused").textContent = text;
  $("refused").hidden = false;
  clearTimeout(refusedTimer);
  refusedTimer = setTimeout(() => { $("refused").hidden = true; }, 5000);
}

// --- Connection.

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const mine = new WebSocket(`${scheme}://${location.host}/ws?${new URLSearchParams({ token, client })}`);
  socket = mine;
  let beat = 0;
  // A connection that neither opens nor fails is given up, or the page would wait for it for minutes.
  const patience = setTimeout(() => mine.close(), 5000);
  mine.onopen = () => {
    clearTimeout(patience);
    wait = 250;
    beat = setInterval(() => mine.readyState === WebSocket.OPEN && mine.send('{"alive":true}'), 1000);
  };
  mine.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.snapshot) show(message.snapshot);
    else if (!message.ok) refuse(message.error);
  };
  mine.onclose = async () => {
    clearTimeout(patience);
    clearInterval(beat);
    if (socket !== mine) return;
    socket = null;
    online();
    const status = await request("/api/state").then((answer) => answer.status, () => 0);
    if (status === 401 || status === 403) {
      lost("Not allowed in.", "The token is missing or wrong. Open the page by the address that the run printed.");
      return;
    }
    setTimeout(connect, wait);
    wait = Math.min(wait * 2, 3000);
  };
}

function lost(title, text) {
  $("offline").hidden = false;
  $("offline-title").textContent = title;
  $("offline-text").textContent = text;
  document.body.classList.add("offline", "denied");
  $("state-name").textContent = "No access";
  $("state-hint").textContent = "Nothing is shown without the right token.";
}

function online() {
  if (document.body.classList.contains("denied")) return;
  const age = (performance.now() - shownAt) / 1000;
  const fine = Boolean(socket && socket.readyState === WebSocket.OPEN && shown && age < 3);
  const ended = over();
  document.body.classList.toggle("online", fine);
  document.body.classList.toggle("offline", !fine && Boolean(shown) && !ended);
  $("connection-text").textContent = fine ? "Connected" : ended ? "Closed" : "Not connected";
  if (!fine && shown && !ended) say($("state-name"), `Last known: ${(WORDS[shown.session.state] || [shown.session.state])[0]}`);
  $("offline").hidden = fine || ended || (!shown && performance.now() < 3000);
  if (!fine && !ended) {
    $("offline-title").textContent = "No connection.";
    $("offline-text").textContent = shown
      ? `What you see is ${Math.round(age)} s old. A moving arm pauses by itself while its operator is away. Trying again …`
      : "The run cannot be reached. Trying again …";
  }
  controls(fine);
}

// --- What is shown.

function show(snapshot) {
  const before = shown;
  shown = snapshot;
  shownAt = performance.now();
  const { session, timers, control } = snapshot;
  document.body.dataset.state = session.state;
  const [word, hint] = WORDS[session.state] || [session.state, ""];
  const name = session.evaluating && !["faulted", "stopped"].includes(session.state) ? `${word} · evaluation` : word;
  say($("state-name"), name);
  say($("state-hint"), session.state === "faulted" && session.fault ? `${session.fault} ${hint}`
    : session.homing ? `The arm goes home: keep clear. Pause (Space) holds it. ${hint}`
    : session.free ? "The arm can be moved by hand: hold it. By hand (M) again, or any other step, makes it hold itself."
    : session.state === "waiting" && session.busy ? "The learner is at work: the next episode can start when it is done." : hint);
  document.title = `${name} · operator`;
  say($("episode-number"), session.episode >= 0 ? String(session.episode) : session.evaluating ? `E${-session.episode}` : "–");
  viewing(control);
  working(session.busy || "", snapshot.progress, timers.busy_s);
  facts("health", snapshot.health);
  facts("learner", snapshot.learner);
  if (!before || JSON.stringify(before.curve) !== JSON.stringify(snapshot.curve)) drawCurve($("curve"), snapshot.curve);
  say($("recent"), String(snapshot.curve.recent));
  if (!before || JSON.stringify(before.log) !== JSON.stringify(snapshot.log)) log(snapshot.log);
  cameras.names(snapshot.cameras, snapshot.camera_age_s);
  films.list(snapshot.finished, control.you === "operator", session);
  tick();
  online();
}

// Only what differs is written: a screen reader repeats what is written again.
function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function viewing(control) {
  const viewer = control.you !== "operator";
  $("viewing").hidden = !viewer;
  say($("viewing-text"), !control.operator ? "Nobody has control."
    : control.present ? "Another page has control. You can still pause and stop." : "The page that has control is not there. You can still pause and stop.");
  say($("who"), `${viewer ? "Viewing only" : "You have control"} · ${control.pages} ${control.pages === 1 ? "page" : "pages"} open`);
}

function working(busy, progress, busySeconds) {
  const runs = progress && progress.total > 0 && progress.done < progress.total;
  $("working").hidden = !busy && !runs;
  if (runs) {
    $("working-bar").max = progress.total;
    $("working-bar").value = progress.done;
  } else $("working-bar").removeAttribute("value");
  const parts = [];
  if (busy) parts.push(`Learner: ${busy}${busySeconds === null ? "" : `, ${duration(busySeconds)}`}`);
  if (runs) {
    parts.push(`${progress.name} ${Math.round(progress.done).toLocaleString("en")} of ${Math.round(progress.total).toLocaleString("en")}`);
    if (progress.eta_s !== null) parts.push(`${duration(progress.eta_s)} left`);
    if (progress.note) parts.push(progress.note);
  }
  say($("working-text"), parts.join(" · "));
}

function facts(id, values) {
  const list = $(id);
  const entries = Object.entries(values);
  $(`no-${id}`).hidden = entries.length > 0;
  const known = new Map([...list.children].map((child) => [child.dataset.name, child]));
  for (const [name, value] of entries) {
    const [title, unit, digits] = FACTS[name] || [name.replaceAll("_", " "), "", 1];
    let entry = known.get(name);
    if (!entry) {
      entry = document.createElement("div");
      entry.dataset.name = name;
      entry.append(document.createElement("dt"), document.createElement("dd"));
      entry.firstChild.textContent = title;
      list.append(entry);
    }
    const text = typeof value === "number" ? (Number.isInteger(value) ? value.toLocaleString("en") : value.toFixed(digits)) : value === null ? "–" : value;
    say(entry.lastChild, unit && value !== null ? `${text} ${unit}` : String(text));
  }
}

function log(lines) {
  const list = $("log");
  const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 30;
  list.replaceChildren(...lines.map(({ time, text }) => {
    const line = document.createElement("li");
    const when = document.createElement("time");
    when.textContent = new Date(time * 1000).toTimeString().slice(0, 8);
    line.append(when, text);
    return line;
  }));
  if (atEnd) list.scrollTop = list.scrollHeight;
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.max(0, Math.floor(seconds));
  const two = (n) => String(n).padStart(2, "0");
  const hours = Math.floor(whole / 3600);
  return hours ? `${hours}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}` : `${Math.floor(whole / 60)}:${two(whole % 60)}`;
}

// Between two snapshots the timers go on by this page's own clock.
function tick() {
  if (!shown) return;
  const since = Math.min((performance.now() - shownAt) / 1000, 3);
  const { session, timers } = shown;
  const moving = ["running", "paused", "teaching", "labelling"].includes(session.state);
  say($("state-time"), duration(timers.state_s + since));
  say($("run-time"), duration(timers.run_s + since));
  say($("episode-time"), timers.episode_s === null ? "–" : duration(timers.episode_s + (moving ? since : 0)));
}

// --- What is pressed.

function over() {
  return Boolean(shown && shown.session.state === "stopped");
}

function controls(fine) {
  const allowed = (shown && shown.session.allowed) || [];
  const operator = shown && shown.control.you === "operator";
  for (const button of document.querySelectorAll("#controls button")) {
    const events = button.dataset.events.split(" ");
    const event = [...events].sort((a, b) => (b === "pause") - (a === "pause")).find((name) => allowed.includes(name));
    const mayPress = event && (URGENT.includes(event) || (fine && operator));
    button.disabled = !mayPress || over();
    if (events[0] === "free") button.setAttribute("aria-pressed", String(Boolean(shown && shown.session.free)));
    button.dataset.event = event || "";
    say(button.firstElementChild, NAMES[event || events[0]]);
  }
}

$("controls").addEventListener("click", ({ target }) => {
  const button = target.closest("button");
  if (button && !button.disabled) send(button.dataset.event);
});

document.addEventListener("keydown", (press) => {
  const key = KEYS[press.key.toLowerCase()] || press.key.toUpperCase();
  const button = document.querySelector(`#controls button[data-key="${CSS.escape(key)}"]`);
  if (!button) return;
  const event = key === "Esc" ? "stop" : button.dataset.event;
  const typing = press.target.closest?.("input:not([type=range]), textarea, select, [contenteditable]");
  // Stop and pause come through whatever has the focus, and whatever else is held down.
  if (!URGENT.includes(event) && (press.ctrlKey || press.altKey || press.metaKey || typing)) return;
  press.preventDefault(); // Space would press whatever has the focus, too
  if (press.repeat) return; // the key has done its work when it went down
  if (!button.disabled || (event === "stop" && !over())) {
    send(event);
    button.focus({ preventScroll: true });
  }
});
// Space on a focused button fires a click when it is let go: the key has done its work by then.
document.addEventListener("keyup", (press) => press.key === " " && press.target.closest?.("button") && press.preventDefault());
$("take-control").addEventListener("click", () => post("/api/control", {}));

const cameras = new Cameras($("cameras"), request, () => document.body.classList.contains("online"));
const films = new Films(request, (episode, label) => post("/api/correct", { episode, label }));
setInterval(() => { tick(); online(); }, 500);
connect();
