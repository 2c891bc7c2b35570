// The page: shows one episode, sends what the person decides, and draws what the server says will become of it.
import { Player } from "./player.js";
import { Track } from "./track.js";

const $ = (id) => document.getElementById(id);

// The token stays in this tab and leaves the address bar, so that it is in no history and on no shared screen.
const given = new URLSearchParams(location.search).get("token");
if (given) {
  sessionStorage.setItem("token", given);
  history.replaceState(null, "", location.pathname);
}
const token = sessionStorage.getItem("token") || "";

export function address(path, query = {}) {
  return `${path}?${new URLSearchParams({ ...query, token })}`;
}

let recording = null;
let state = null;
let current = 0;
let looked = null; // what becomes of the current episode
let refusedTimer = 0;
let moving = 0; // counts the movements of a slider, so that an old answer never overtakes a newer one

async function ask(path, body) {
  const options = body === undefined ? {} : { method: "POST", body: JSON.stringify(body) };
  const headers = { "X-Token": token, ...(body === undefined ? {} : { "Content-Type": "application/json" }) };
  let answer;
  try {
    answer = await fetch(path, { ...options, headers });
  } catch {
    refuse("The review has ended, or does not answer: start cqn-data review again.");
    return null;
  }
  const found = await answer.json();
  if (answer.ok) return found;
  refuse(found.error);
  return null;
}

function refuse(text) {
  $("refused").textContent = text;
  $("refused").hidden = false;
  clearTimeout(refusedTimer);
  refusedTimer = setTimeout(() => { $("refused").hidden = true; }, 6000);
}

const player = new Player($("films"), address, (frame) => {
  track.place(frame);
  const at = frame / recording.fps;
  $("place").textContent = `step ${frame} of ${recording.episodes[current].steps}, ${at.toFixed(1)} s`;
});
const track = new Track(address, {
  seek: (frame) => player.seek(frame),
  cut: (changes) => decide(changes),
});

// --- Decisions.

const decision = (index = current) => ({ success: null, drop: false, head: 0, tail: 0, threshold: null, task: null, ...state.episodes[index] });

async function decide(changes, index = current) {
  take(await ask("/api/decide", { episode: index, changes }));
}

async function label(kind) {
  const now = decision();
  if (kind === "drop") await decide({ drop: !now.drop });
  else await decide({ success: now.success === (kind === "success") ? null : kind === "success", drop: false });
}

function take(found) {
  if (!found) return;
  state = found;
  show();
  look();
}

async function look(threshold) {
  const mine = ++moving;
  const path = `/api/pauses/${current}`;
  const found = await ask(threshold === undefined ? path : address(path, { threshold }));
  if (!found || mine !== moving) return;
  looked = found;
  player.plan($("skip").checked ? found : null);
  track.mark(found);
}

function cutHere(end) {
  const steps = recording.episodes[current].steps;
  decide(end === "start" ? { head: Math.min(player.frame, steps - 2) } : { tail: Math.max(0, steps - 1 - player.frame) });
}

async function open(index) {
  current = Math.max(0, Math.min(recording.episodes.length - 1, index));
  const mine = current;
  player.pause();
  show();
  const curves = await ask(`/api/episode/${mine}`);
  if (!curves || mine !== current) return;
  const { steps } = recording.episodes[mine];
  track.open(mine, steps, curves, recording);
  player.open(mine, steps, recording, curves.films);
  await look();
}

// --- What is shown.

function row(episode, index) {
  const now = decision(index);
  const success = now.success ?? episode.success;
  const button = document.createElement("button");
  button.type = "button";
  button.className = [now.success === null ? "" : "decided", success ? "success" : success === false ? "failure" : "", now.drop ? "dropped" : ""].join(" ");
  if (index === current) button.setAttribute("aria-current", "true");
  const gone = episode.steps - state.kept[index];
  const flags = [now.head || now.tail ? "cut" : "", now.threshold === null ? "" : "own", now.task === null ? "" : "task"].filter(Boolean).join(" ");
  const words = [["mark", now.drop ? "–" : success ? "✓" : success === false ? "✗" : "·"], ["", index], ["share", `${state.kept[index]} of ${episode.steps}`], ["flags", flags]];
  for (const [kind, text] of words) {
    const span = document.createElement("span");
    span.className = kind;
    span.textContent = text;
    button.append(span);
  }
  button.title = now.drop ? "left out" : `${gone} steps go`;
  button.onclick = () => open(index);
  const item = document.createElement("li");
  item.append(button);
  return item;
}

function show() {
  const { episodes, pauses } = recording;
  $("episodes").replaceChildren(...episodes.map(row));
  $("episodes").children[current].scrollIntoView({ block: "nearest" });
  const all = episodes.reduce((sum, e) => sum + e.steps, 0);
  const { total } = state;
  $("overview").textContent = `${total.episodes} of ${episodes.length} episodes and ${total.kept} of ${all} steps stay (${Math.round((100 * total.kept) / all)} %)`;
  $("undo").disabled = !state.undoable;
  const now = decision();
  for (const button of document.querySelectorAll("#labels [data-label]")) {
    const kind = button.dataset.label;
    button.setAttribute("aria-pressed", String(kind === "drop" ? now.drop : now.success === (kind === "success")));
  }
  if (document.activeElement !== $("task")) $("task").value = now.task ?? episodes[current].task;
  for (const id of ["pauses-on", "threshold", "own-on", "own"]) $(id).disabled = !pauses;
  if (pauses) showThresholds(pauses, now);
  else $("threshold-why").textContent = "There are no states and actions in which pauses could be seen.";
  $("file").textContent = state.file;
  $("command").textContent = state.command;
  $("recipe").textContent = state.recipe || "Nothing is decided yet.";
  const { errand } = state;
  $("lines").hidden = errand.lines.length === 0 && !errand.running;
  $("lines").textContent = [...errand.lines, errand.running ? "…" : errand.code ? `Ended with exit code ${errand.code}.` : ""].filter(Boolean).join("\n");
  $("run").querySelector("button").disabled = errand.running;
}

function showThresholds(pauses, now) {
  const on = state.threshold !== null;
  const value = state.threshold ?? pauses.suggested;
  $("pauses-on").checked = on;
  $("threshold").disabled = !on;
  $("own-on").disabled = !on;
  $("own-on").checked = now.threshold !== null;
  $("own").disabled = !on || now.threshold === null;
  if (!$("threshold").matches(":active")) $("threshold").value = toSlider(value);
  if (!$("own").matches(":active")) $("own").value = now.threshold === 0 ? 0 : toSlider(now.threshold ?? value);
  $("threshold-value").textContent = digits(value);
  $("own-value").textContent = now.threshold === null ? "" : now.threshold === 0 ? "keep all" : digits(now.threshold);
  $("threshold-why").textContent = `Suggested: ${digits(pauses.suggested)}. ${pauses.reason}`;
}

const digits = (value) => Number(value.toPrecision(3)).toString();
// The first notch is apart: for one episode it keeps all.
const span = () => [Math.log(recording.pauses.low / 2), Math.log(recording.pauses.high)];
const toSlider = (value) => Math.round(1 + (999 * (Math.log(value) - span()[0])) / (span()[1] - span()[0]));
const fromSlider = (place) => Number(Math.exp(span()[0] + ((Math.max(1, place) - 1) / 999) * (span()[1] - span()[0])).toPrecision(3));

// --- Hands.

function listen() {
  for (const button of document.querySelectorAll("#labels [data-label]")) button.onclick = () => label(button.dataset.label);
  for (const button of document.querySelectorAll("[data-cut]")) button.onclick = () => cutHere(button.dataset.cut);
  $("previous").onclick = () => open(current - 1);
  $("next").onclick = () => open(current + 1);
  $("play").onclick = () => player.toggle();
  player.changed = (playing) => { $("play").firstElementChild.textContent = playing ? "Pause" : "Play"; };
  $("undo").onclick = async () => take(await ask("/api/undo", {}));
  $("to-recipe").onclick = () => $("recipe-card").scrollIntoView({ behavior: "smooth" });
  $("skip").onchange = () => player.plan($("skip").checked ? looked : null);
  $("pauses-on").onchange = common;
  $("threshold").oninput = () => {
    $("threshold-value").textContent = digits(fromSlider(Number($("threshold").value)));
    look(fromSlider(Number($("threshold").value)));
  };
  $("threshold").onchange = common;
  $("own-on").onchange = () => decide({ threshold: $("own-on").checked ? fromSlider(Number($("threshold").value)) : null });
  $("own").onchange = () => decide({ threshold: Number($("own").value) === 0 ? 0 : fromSlider(Number($("own").value)) });
  $("task").onchange = () => {
    const text = $("task").value.trim();
    decide({ task: text && text !== recording.episodes[current].task ? text : null });
  };
  $("task-all").onclick = async () => {
    const text = $("task").value.trim();
    for (let i = 0; text && i < recording.episodes.length; i++) await decide({ task: text === recording.episodes[i].task ? null : text }, i);
  };
  $("run").onsubmit = async (event) => {
    event.preventDefault();
    take(await ask("/api/run", { new_repo_id: $("new-repo").value, new_root: $("new-root").value }));
    follow();
  };
  addEventListener("keydown", press);
  addEventListener("resize", () => track.draw());
}

async function common() {
  take(await ask("/api/threshold", { threshold: fromSlider(Number($("threshold").value)), on: $("pauses-on").checked }));
}

async function follow() {
  while (state.errand.running) {
    await new Promise((done) => setTimeout(done, 500));
    const found = await ask("/api/state");
    if (!found) return;
    state = found;
    show();
  }
}

const KEYS = {
  " ": () => player.toggle(), s: () => label("success"), f: () => label("failure"), d: () => label("drop"),
  n: () => open(current + 1), p: () => open(current - 1), u: () => $("undo").click(),
  "[": () => cutHere("start"), "]": () => cutHere("stop"),
  arrowright: () => player.seek(player.frame + 1), arrowleft: () => player.seek(player.frame - 1),
};

function press(event) {
  const field = event.target.matches?.("input[type=text], input[type=range], [role=slider]");
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (field && (event.target.type === "text" || event.key.startsWith("Arrow"))) return;
  const action = KEYS[event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  action();
}

async function begin() {
  recording = await ask("/api/recording");
  if (!recording) return;
  state = await ask("/api/state");
  if (!state) return;
  $("name").textContent = recording.repo_id;
  document.title = `Review of ${recording.repo_id}`;
  listen();
  await open(0);
  document.body.dataset.ready = "true";
  follow();
}

begin();
