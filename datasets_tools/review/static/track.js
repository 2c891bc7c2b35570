// Film strip, joints, what goes and the two ends over the steps of one episode.
const $ = (id) => document.getElementById(id);
const COLOURS = ["#2f7de1", "#d9541e", "#1a9850", "#9b59d0", "#c2185b", "#0d96a8", "#b58900", "#6d7b8d"];
const HEIGHT = 100;

export class Track {
  constructor(address, { seek, cut }) {
    Object.assign(this, { address, seek, cut, steps: 1, head: 0, looked: null, strip: 0 });
    const track = $("track");
    const follow = (event) => this.seek(this.frameAt(event));
    track.addEventListener("pointerdown", (event) => {
      if (event.target.classList.contains("handle")) return;
      track.setPointerCapture(event.pointerId);
      follow(event);
      track.onpointermove = follow;
    });
    track.addEventListener("pointerup", () => { track.onpointermove = null; });
    track.addEventListener("pointercancel", () => { track.onpointermove = null; });
    for (const end of ["start", "stop"]) this.handle(end);
  }

  frameAt(event) {
    const box = $("track").getBoundingClientRect();
    return Math.max(0, Math.min(this.steps - 1, Math.floor(((event.clientX - box.left) / box.width) * this.steps)));
  }

  handle(end) {
    const handle = $(end);
    const changes = (frame) => (end === "start" ? { head: Math.min(frame, this.looked.stop - 2) } : { tail: this.steps - Math.max(frame + 1, this.looked.start + 2) });
    handle.addEventListener("pointerdown", (event) => {
      handle.setPointerCapture(event.pointerId);
      handle.onpointermove = (moved) => {
        const frame = this.frameAt(moved);
        const { head = this.looked.start, tail = this.steps - this.looked.stop } = changes(frame);
        this.looked = { ...this.looked, start: head, stop: this.steps - tail };
        this.ends();
        this.seek(frame);
      };
    });
    handle.addEventListener("pointerup", (event) => {
      handle.onpointermove = null;
      this.cut(changes(this.frameAt(event)));
    });
    handle.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (by) this.cut(changes(end === "start" ? Math.max(0, this.looked.start + by) : Math.min(this.steps - 1, this.looked.stop - 1 + by)));
    });
  }

  async open(episode, steps, curves, recording) {
    Object.assign(this, { steps, looked: null });
    $("marks").replaceChildren();
    this.drawCurves(curves, recording.state_names);
    const camera = recording.cameras[0];
    $("strip").hidden = !camera;
    if (!camera) return;
    const wide = (54 * camera.width) / camera.height;
    this.thumbs = null;
    this.draw();
    const count = Math.max(1, Math.min(24, steps, Math.ceil($("track").clientWidth / wide)));
    const mine = ++this.strip;
    const image = new Image();
    image.src = this.address(`/api/pictures/${episode}/${camera.key}`, { count, height: 108 });
    await image.decode().catch(() => {});
    if (mine !== this.strip || !image.naturalWidth) return;
    this.thumbs = { image, count };
    this.draw();
  }

  drawCurves({ every, states }, names) {
    const paths = states.map((values, i) => {
      const low = Math.min(...values);
      const high = Math.max(...values);
      const y = (v) => HEIGHT - 6 - ((HEIGHT - 12) * (high > low ? v - low : 0.5)) / (high > low ? high - low : 1);
      const points = values.map((v, k) => `${(k * every + 0.5).toFixed(1)} ${y(v).toFixed(1)}`);
      return `<path stroke="${COLOURS[i % COLOURS.length]}" d="M${points.join("L")}"/>`;
    });
    $("curves").innerHTML = `<svg viewBox="0 0 ${this.steps} ${HEIGHT}" preserveAspectRatio="none">${paths.join("")}</svg>`;
    const legend = names.map((name, i) => {
      const item = document.createElement("span");
      const line = document.createElement("i");
      line.style.background = COLOURS[i % COLOURS.length];
      item.append(line, name);
      return item;
    });
    const gone = document.createElement("span");
    const box = document.createElement("i");
    box.className = "gone";
    gone.append(box, "steps that go");
    $("legend").replaceChildren(...legend, gone);
  }

  draw() {
    const canvas = $("strip");
    const scale = devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * scale;
    canvas.height = 54 * scale;
    if (!this.thumbs) return;
    const { image, count } = this.thumbs;
    const pen = canvas.getContext("2d");
    const wide = image.naturalWidth / count;
    const place = canvas.width / count;
    // Each thumbnail fills its place; what does not fit is cut off on both sides, or above and below.
    const zoom = Math.max(place / wide, canvas.height / image.naturalHeight);
    const [w, h] = [place / zoom, canvas.height / zoom];
    for (let i = 0; i < count; i++) {
      pen.drawImage(image, i * wide + (wide - w) / 2, (image.naturalHeight - h) / 2, w, h, i * place, 0, place, canvas.height);
    }
  }

  mark(looked) {
    this.looked = looked;
    const share = (step) => `${(100 * step) / this.steps}%`;
    $("marks").replaceChildren(...looked.runs.map(([first, length]) => {
      const box = document.createElement("div");
      box.className = "gone";
      Object.assign(box.style, { left: share(first), width: share(length) });
      return box;
    }));
    for (const side of ["left", "right"]) {
      const box = document.createElement("div");
      box.className = `cut ${side}`;
      $("marks").append(box);
    }
    this.ends();
  }

  ends() {
    const { start, stop } = this.looked;
    const [left, right] = [(100 * start) / this.steps, (100 * stop) / this.steps];
    $("start").style.left = `${left}%`;
    $("stop").style.left = `${right}%`;
    $("start").setAttribute("aria-valuenow", start);
    $("stop").setAttribute("aria-valuenow", stop);
    const [before, after] = [document.querySelector("#marks .left"), document.querySelector("#marks .right")];
    Object.assign(before.style, { left: 0, width: `${left}%` });
    Object.assign(after.style, { left: `${right}%`, width: `${100 - right}%` });
  }

  place(frame) {
    $("head").style.left = `${(100 * (frame + 0.5)) / this.steps}%`;
  }
}
