// The learning curve, drawn by hand: episodes as dots, their running mean, evaluations with their intervals.
const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [420, 170, 46, 10, 10, 24];

function element(name, attributes, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

export function drawCurve(place, { episodes, evaluations }) {
  const numbers = [...episodes.map(([number]) => number), ...evaluations.map((e) => e.episodes ?? 0)];
  const last = Math.max(10, ...numbers);
  const x = (number) => LEFT + (number / last) * (WIDTH - LEFT - RIGHT);
  const y = (share) => TOP + (1 - share) * (HEIGHT - TOP - BOTTOM);
  const mean = episodes.length ? episodes[episodes.length - 1][2] : null;
  const summary = mean === null ? "No episode yet" : `${episodes.length} episodes, lately ${Math.round(mean * 100)} % successful`;
  const svg = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `Learning curve: ${summary}` });
  for (const share of [0, 0.5, 1]) {
    svg.append(element("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(share), y2: y(share) }));
    svg.append(element("text", { x: LEFT - 6, y: y(share) + 4, "text-anchor": "end" }, `${share * 100} %`));
  }
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((s) => last / s <= 6) || 2000;
  for (let tick = 0; tick <= last; tick += step) {
    svg.append(element("text", { x: x(tick), y: HEIGHT - 7, "text-anchor": "middle" }, String(tick)));
  }
  const radius = episodes.length > 80 ? 1.8 : 3;
  for (const [number, success] of episodes) {
    svg.append(element("circle", { class: `episode ${success ? "success" : ""}`, cx: x(number), cy: y(success), r: radius }));
  }
  if (episodes.length) {
    svg.append(element("polyline", { class: "mean", points: episodes.map(([n, , m]) => `${x(n)},${y(m)}`).join(" ") }));
  }
  for (const { episodes: after, success_rate: rate, ci_low: low, ci_high: high } of evaluations) {
    if (rate === null || rate === undefined) continue;
    const [cx, cy] = [x(after ?? 0), y(rate)];
    if (low !== null && high !== null && low !== undefined) {
      svg.append(element("line", { class: "evaluation", x1: cx, x2: cx, y1: y(low), y2: y(high) }));
    }
    svg.append(element("rect", { class: "evaluation", x: cx - 4, y: cy - 4, width: 8, height: 8, transform: `rotate(45 ${cx} ${cy})` }));
  }
  place.replaceChildren(svg);
}
