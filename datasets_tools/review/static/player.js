// The films of one episode, all cameras together: as the files are, or picture by picture where the browser cannot play them.
export class Player {
  constructor(place, address, moved) {
    Object.assign(this, { place, address, moved, frame: 0, steps: 1, fps: 10, views: [], skips: null, playing: false, changed: () => {} });
  }

  open(episode, steps, recording, films) {
    Object.assign(this, { episode, steps, fps: recording.fps, frame: 0 });
    this.views = recording.cameras.map((camera) => this.view(camera, films[camera.key]));
    this.place.replaceChildren(...this.views.map((view) => view.figure));
    this.seek(0);
  }

  view(camera, span) {
    const figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    caption.textContent = camera.key.replace("observation.images.", "");
    const view = { figure, camera, video: null, image: null, from: 0, waiting: -1 };
    if (camera.film) {
      const video = document.createElement("video");
      Object.assign(video, { muted: true, playsInline: true, preload: "auto" });
      video.src = this.address(`/api/film/${this.episode}/${camera.key}`);
      view.video = video;
      [view.from] = span;
      video.onerror = () => this.fallBack(view);
      figure.append(video, caption);
    } else {
      figure.append(caption);
      this.fallBack(view);
    }
    return view;
  }

  fallBack(view) {
    view.video?.remove();
    view.video = null;
    view.image = document.createElement("img");
    view.image.alt = view.camera.key;
    view.figure.prepend(view.image);
    this.picture(view);
  }

  // One request at a time for each camera; the newest frame waits.
  picture(view) {
    view.waiting = this.frame;
    if (view.busy) return;
    const frame = view.waiting;
    view.busy = true;
    view.image.onload = view.image.onerror = () => {
      view.busy = false;
      if (view.waiting !== frame) this.picture(view);
    };
    view.image.src = this.address(`/api/pictures/${this.episode}/${view.camera.key}`, { first: frame });
  }

  // In the middle of a picture's time, so that rounding never shows its neighbour.
  time(view, frame) { return view.from + (frame + 0.5) / this.fps; }

  seek(frame) {
    this.frame = Math.max(0, Math.min(this.steps - 1, Math.round(frame)));
    for (const view of this.views) {
      if (view.video) view.video.currentTime = this.time(view, this.frame);
      else this.picture(view);
    }
    this.moved(this.frame);
  }

  plan(looked) {
    this.skips = looked;
  }

  // The step that follows in the result: what goes is jumped over. -1 at the end.
  following(frame) {
    if (!this.skips) return frame < this.steps ? frame : -1;
    let next = Math.max(frame, this.skips.start);
    for (const [first, length] of this.skips.runs) if (next >= first && next < first + length) next = first + length;
    return next < this.skips.stop ? next : -1;
  }

  toggle() { if (this.playing) this.pause(); else this.play(); }

  pause() {
    this.playing = false;
    for (const { video } of this.views) video?.pause();
    this.changed(false);
  }

  play() {
    if (this.following(this.frame + 1) < 0) this.seek(Math.max(0, this.following(0)));
    this.playing = true;
    this.changed(true);
    const mine = (this.run = (this.run ?? 0) + 1);
    let begun = performance.now();
    let base = this.frame;
    for (const { video } of this.views) video?.play().catch(() => {});
    const turn = () => {
      if (!this.playing || mine !== this.run) return;
      const due = base + Math.floor(((performance.now() - begun) / 1000) * this.fps);
      if (due > this.frame) {
        const next = this.following(due);
        if (next < 0 || next >= this.steps) {
          this.pause();
          return;
        }
        if (next > due) [base, begun] = [next, performance.now()];
        this.frame = next;
        for (const view of this.views) {
          if (!view.video) this.picture(view);
          else if (Math.abs(view.video.currentTime - this.time(view, next)) > 0.25) view.video.currentTime = this.time(view, next);
        }
        this.moved(next);
      }
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
  }
}
