// Live pictures: each camera asks for the next one when the last is there, at most RATE times a second.
const RATE = 10;
const STALE_MS = 2500;

export class Cameras {
  constructor(place, request, live) {
    this.place = place;
    this.request = request;
    this.live = live; // whether the run can be reached
    this.ages = {}; // seconds since the robot gave each picture, as the last snapshot says
    this.views = new Map();
  }

  names(names, ages) {
    this.ages = ages || {};
    for (const name of names) {
      if (this.views.has(name)) continue;
      if (!this.views.size) this.place.replaceChildren();
      const figure = document.createElement("figure");
      const image = document.createElement("img");
      const caption = document.createElement("figcaption");
      image.alt = `Camera ${name}`;
      caption.textContent = name;
      figure.append(image, caption);
      this.place.append(figure);
      this.views.set(name, figure);
      this.follow(name, figure, image);
    }
  }

  async follow(name, figure, image) {
    let last = performance.now();
    for (;;) {
      const began = performance.now();
      try {
        if (!document.hidden && this.live()) {
          const answer = await this.request(`/api/camera/${encodeURIComponent(name)}.jpg`);
          if (!answer.ok) throw new Error(answer.statusText);
          const url = URL.createObjectURL(await answer.blob());
          const before = image.src;
          image.src = url;
          await image.decode().catch(() => {});
          if (before) URL.revokeObjectURL(before);
          last = performance.now();
        }
      } catch {
        await new Promise((done) => setTimeout(done, 700));
      }
      figure.classList.toggle("stale", performance.now() - last > STALE_MS || this.ages[name] * 1000 > STALE_MS);
      await new Promise((done) => setTimeout(done, Math.max(20, 1000 / RATE - (performance.now() - began))));
    }
  }
}
