"use strict";
// Shows what the run and each of its arms does; asked for once a second.
const token = new URLSearchParams(location.search).get("token") || "";
const byId = (id) => document.getElementById(id);
const WORDS = {
  joining: "is getting ready", idle: "waits for the learner", acting: "acts", lost: "does not answer", left: "has left",
  waiting: "waits for its person", running: "the policy drives", paused: "paused", teaching: "a person drives",
  labelling: "how did it go?", resetting: "the scene is set up", faulted: "fault", stopped: "stopped",
  evaluating: "is evaluated",
};

function card(arm) {
  const item = document.createElement("li");
  item.dataset.state = arm.state;
  const add = (kind, text, style) => {
    const part = document.createElement(kind);
    part.textContent = text;
    if (style) part.className = style;
    item.append(part);
    return part;
  };
  add("strong", `Arm ${arm.collector}: ${WORDS[arm.state] || arm.state}`);
  add("span", arm.host, "place");
  add("p", `${arm.episodes} episodes, ${arm.successes} successes`, "counts");
  if (arm.page) {
    const link = add("a", `Page of arm ${arm.collector}`);
    link.href = arm.page;
    link.target = "_blank";
    link.rel = "noopener";
  }
  return item;
}

let before = "";
async function look() {
  try {
    const answer = await fetch("api/state", { headers: { "X-Token": token } });
    if (!answer.ok) throw new Error((await answer.json()).error);
    const seen = await answer.json();
    document.body.classList.remove("offline");
    byId("phase").textContent = `${seen.phase || "starting"}: ${seen.done} of ${seen.total}`;
    byId("note").textContent = seen.note;
    byId("progress").value = seen.total ? seen.done / seen.total : 0;
    const now = JSON.stringify([seen.arms, seen.lines]);
    if (now !== before) { // else a link that is being clicked would vanish
      before = now;
      byId("arms").replaceChildren(...seen.arms.map(card));
      byId("lines").replaceChildren(...seen.lines.slice(-12).map((text) => {
        const line = document.createElement("li");
        line.textContent = text;
        return line;
      }));
    }
  } catch (error) {
    document.body.classList.add("offline");
    byId("note").textContent = `No answer: ${error.message}. The run may be over.`;
  }
}
look();
setInterval(look, 1000);
