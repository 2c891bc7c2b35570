// The last episodes: their labels, which may be changed, and their films at the speed at which they happened.
const LABELS = { success: "Success", failure: "Failure", discard: "Discard" };
const MAX_ROWS = 50;
const $ = (id) => document.getElementById(id);

function called(episode) {
  return episode < 0 ? `Evaluation ${-episode}` : `Episode ${episode}`;
}

export class Films {
  constructor(request, correct) {
    this.request = request;
    this.correct = correct;
    this.rows = "";
    this.film = null; // {episode, cameras: [{times, urls, image}], length}
    this.offered = null;
    this.position = 0;
    this.began = null;
    $("film-play").addEventListener("click", () => (this.began === null ? this.play() : this.pause()));
    $("film-seek").addEventListener("input", ({ target }) => {
      this.pause();
      this.at((target.value / 1000) * (this.film ? this.film.length : 0));
    });
    const frame = () => {
      if (this.began !== null && this.film) {
        this.at((performance.now() - this.began) / 1000);
        if (this.position >= this.film.length) this.pause();
      }
      requestAnimationFrame(frame);
    };
    frame();
  }

  list(finished, operator, session) {
    operator = operator && session.state !== "stopped"; // nobody learns from labels any more
    const rows = JSON.stringify([finished, operator]);
    if (rows !== this.rows) {
      this.rows = rows;
      $("no-episodes").hidden = finished.length > 0;
      const focused = document.activeElement?.dataset.focus;
      $("episodes").replaceChildren(...finished.slice(-MAX_ROWS).reverse().map((entry) => this.row(entry, operator)));
      if (focused) document.querySelector(`[data-focus="${focused}"]`)?.focus({ preventScroll: true });
    }
    // The film of the episode that waits for its label is what the person wants to see now.
    const last = finished[finished.length - 1];
    if (session.state === "labelling" && last && last.film && last.episode === session.episode && this.offered !== last.episode) {
      this.offered = last.episode;
      this.open(last);
    }
  }

  row(entry, operator) {
    const row = document.createElement("li");
    const number = document.createElement("span");
    number.className = "number";
    number.textContent = entry.evaluation ? `E${-entry.episode}` : `#${entry.episode}`;
    if (entry.evaluation) number.title = "Evaluation: not learned from";
    const length = document.createElement("span");
    length.className = "length";
    length.textContent = [entry.seconds === null ? "" : `${entry.seconds.toFixed(1)} s`, entry.steps === null ? "" : `${entry.steps} steps`, entry.label ? "" : "no label"]
      .filter(Boolean).join(" · ");
    row.append(number, length);
    if (entry.film) row.append(this.button("Film", `film-${entry.episode}`, () => this.open(entry), `Play the film of ${called(entry.episode).toLowerCase()}`));
    const labels = document.createElement("span");
    labels.className = "labels";
    for (const [label, word] of Object.entries(LABELS)) {
      const name = `Label ${called(entry.episode).toLowerCase()} as ${word.toLowerCase()}`;
      const button = this.button(word, `${label}-${entry.episode}`, () => this.correct(entry.episode, label), name);
      button.dataset.label = label;
      button.setAttribute("aria-pressed", String(entry.label === label));
      button.disabled = !operator || entry.label === null || entry.evaluation;
      labels.append(button);
    }
    row.append(labels);
    return row;
  }

  button(text, focus, press, name) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.dataset.focus = focus;
    button.setAttribute("aria-label", name);
    button.addEventListener("click", press);
    return button;
  }

  async open({ episode, cameras }) {
    this.close();
    const film = { episode, length: 0, cameras: [] };
    this.film = film;
    $("player").hidden = false;
    $("film-title").textContent = `${called(episode)}: loading …`;
    $("film-pictures").replaceChildren();
    for (const name of cameras) {
      const path = `/api/film/${episode}/${encodeURIComponent(name)}`;
      const answer = await this.request(path).catch(() => null);
      if (this.film !== film) return;
      if (!answer || !answer.ok) continue;
      const { times } = await answer.json();
      const figure = document.createElement("figure");
      const image = document.createElement("img");
      image.alt = `${called(episode)}, camera ${name}`;
      const caption = document.createElement("figcaption");
      caption.textContent = name;
      figure.append(image, caption);
      $("film-pictures").append(figure);
      film.cameras.push({ path, times, urls: new Array(times.length), image });
      film.length = Math.max(film.length, times[times.length - 1] ?? 0);
    }
    if (this.film !== film) return;
    if (!film.cameras.length) {
      $("film-title").textContent = `${called(episode)}: its film is no longer kept.`;
      return;
    }
    const enough = this.load(film);
    await enough;
    if (this.film !== film) return;
    $("film-title").textContent = `${called(episode)}, at the speed at which it happened`;
    this.at(0);
    this.play();
  }

  // All pictures are fetched before it plays: a few hundred small ones, and then nothing stutters.
  async load(film) {
    const jobs = film.cameras.flatMap((camera) => camera.times.map((_, index) => [camera, index]));
    let done = 0;
    const worker = async () => {
      for (let job = jobs.shift(); job && this.film === film; job = jobs.shift()) {
        const [camera, index] = job;
        const answer = await this.request(`${camera.path}?frame=${index}`).catch(() => null);
        if (answer && answer.ok) camera.urls[index] = URL.createObjectURL(await answer.blob());
        done += 1;
        if (this.film === film) $("film-title").textContent = `${called(film.episode)}: loading ${Math.round((100 * done) / (done + jobs.length))} %`;
      }
    };
    await Promise.all([worker(), worker(), worker()]);
    if (this.film !== film) this.free(film);
  }

  at(seconds) {
    if (!this.film) return;
    this.position = Math.min(Math.max(seconds, 0), this.film.length);
    for (const { times, urls, image } of this.film.cameras) {
      let index = 0;
      while (index + 1 < times.length && times[index + 1] <= this.position) index += 1;
      if (urls[index] && image.src !== urls[index]) image.src = urls[index];
    }
    $("film-seek").value = this.film.length ? (1000 * this.position) / this.film.length : 0;
    $("film-time").textContent = `${this.position.toFixed(1)} / ${this.film.length.toFixed(1)} s`;
  }

  play() {
    if (!this.film) return;
    if (this.position >= this.film.length) this.position = 0;
    this.began = performance.now() - this.position * 1000;
    $("film-play").textContent = "Pause";
    $("film-play").setAttribute("aria-label", "Pause the film");
  }

  pause() {
    this.began = null;
    $("film-play").textContent = "Play";
    $("film-play").setAttribute("aria-label", "Play the film");
  }

  close() {
    this.pause();
    if (this.film) this.free(this.film);
    this.film = null;
    this.position = 0;
  }

  free(film) {
    for (const { urls } of film.cameras) urls.filter(Boolean).forEach((url) => URL.revokeObjectURL(url));
  }
}
