// The page "Now": requests values every second, and curves at an interval that depends on their span. Text is only set as text.
"use strict";

const INTERVAL = 1000; // ms

const number = (value, digits) => (value === null ? "—" : value.toFixed(digits).replace("-", "−"));
const signed = (value, digits) => (value > 0 ? "+" : "") + number(value, digits);
const clock = (text) => new Date(text).toLocaleTimeString("en-GB");

function show(found) {
  byId("clock").textContent = found.error ? `The monitor has stopped: ${found.error}`
    : !found.running ? "The monitor has stopped."
    : found.lent ? `${clock(found.time)}, ${found.rows} samples${found.run ? ` in ${found.run}` : ""}`
    : found.rows ? `${clock(found.time)}, ${found.rows} rows in ${found.run}` : "Waiting for the first readings.";
  byId("lent").textContent = found.lent && `${found.lent} This page reads the instruments again after its end.`;
  byId("lent").hidden = !found.lent;
  byId("alarms").replaceChildren(...found.alarms.map((text) => element("li", `Alarm: ${text}`)));
  byId("instruments").replaceChildren(...found.instruments.map((each) => {
    const tile = element("li", undefined, each.state);
    const words = { answers: "● answers", waiting: "○ waiting", silent: `■ no answer since ${clock(each.since)}`, lent: `◐ used by another program since ${clock(each.since)}` };
    tile.append(element("strong", each.name), element("span", words[each.state], "said"), element("small", each.model || each.kind));
    if (each.why) tile.append(element("small", each.why));
    if (each.rate !== null) tile.append(element("small", `${number(each.rate, each.rate < 10 ? 2 : 0)} readings/s`, "rate"));
    if (each.missed) tile.append(element("small", `${each.missed} of ${found.rows} rows without a reading`, "drops"));
    return tile;
  }));
  byId("parameters-card").hidden = !found.parameters.length;
  byId("parameters").replaceChildren(...found.parameters.map((each) => {
    const row = element("div");
    const value = element("dd", number(each.value, each.unit === "mm" ? 3 : 0));
    value.append(element("span", each.unit, "unit"));
    row.append(element("dt", each.name), value);
    return row;
  }));
  byId("recorded-card").hidden = !found.recorded.length;
  byId("recorded").replaceChildren(...found.recorded.map((each) => {
    const row = element("tr"), name = element("th", each.name);
    name.scope = "row";
    row.append(name, element("td", number(each.value, 4), "number"), element("td", each.unit));
    return row;
  }));
  byId("program").textContent = [found.mode && `mode ${found.mode}`, found.program && `program ${found.program}`].filter(Boolean).join(", ");
  const position = "XYZ".split("").map((axis) => found.parameters.find((each) => each.name === axis)?.value ?? null);
  map(found.temperatures, position);
  byId("temperatures-card").hidden = !found.temperatures.length;
  byId("temperatures").replaceChildren(...found.temperatures.map((each) => {
    const row = element("tr"), name = element("th", each.name);
    name.scope = "row";
    const value = element("td", each.flag || number(each.value, 2), each.flag ? "number flagged" : "number");
    row.append(name, value, element("td", signed(each.change, 2), "number"), element("td", number(each.low, 2), "number soft"), element("td", number(each.high, 2), "number soft"));
    return row;
  }));
}

// Cividis, a colour map that is distinguishable with every colour vision, from cold to warm.
const SHADES = ["#00224e", "#2a3f6d", "#575d6d", "#7d7c78", "#a69c75", "#d3bf66", "#fee838"];
const WIDTH = 520, HEIGHT = 260, MARGIN = 46;

function shape(name, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const MACHINE = JSON.parse(byId("map").dataset.machine);

function bodies([h, v], position) { // bed, table, frame and head in one view, mm; a schematic whose sizes follow from the travel
  if (!MACHINE) return [];
  const [[h0, h1], [v0, v1]] = [MACHINE.travel[h], MACHINE.travel[v]], size = 0.16 * Math.max(h1 - h0, v1 - v0);
  const at = (k, low, high) => position[k] ?? (low + high) / 2;
  const tool = [at(h, h0, h1), at(v, v0, v1)], k = MACHINE.spindle;
  const head = k === v ? [tool[0] - size / 2, tool[1], size, 1.6 * size] : k === h ? [tool[0], tool[1] - size / 2, 1.6 * size, size] : [tool[0] - size / 2, tool[1] - size / 2, size, size];
  const nose = k === v ? [tool[0] - size / 8, tool[1], size / 4, size / 4] : k === h ? [tool[0], tool[1] - size / 8, size / 4, size / 4] : [tool[0] - size / 8, tool[1] - size / 8, size / 4, size / 4];
  const named = (name, axes) => (axes.length ? `${name}: ${axes.join(" ")}` : name);
  return [
    { kind: "frame", name: "frame", box: h === 1 ? [h1 + 0.5 * size, v0 - 1.5 * size, 1.6 * size, v1 - v0 + 4 * size] : [(h0 + h1) / 2 - 2 * size, v0 - 0.4 * size, 4 * size, v1 - v0 + 2.9 * size] },
    { kind: "bed", name: "bed", box: [h0 - 0.5 * size, v0 - 1.5 * size, h1 - h0 + size, 0.9 * size] },
    { kind: "table", name: named("table", MACHINE.table), box: [h0, v0 - 0.6 * size, h1 - h0, 0.4 * size] },
    { kind: "travel", name: "", box: [h0, v0, h1 - h0, v1 - v0] },
    { kind: "head", name: named("head", MACHINE.head), box: [head[0], head[1] + (k === v ? size / 4 : 0), head[2], head[3]] },
    { kind: "nose", name: "", box: nose },
  ];
}

// Positions of texts in a drawing: boxes [left, top, right, bottom] in its units. A text takes one of its first positions,
// preferably one that covers no edge; a position over another text or a circle is not allowed.
const INK = document.createElement("canvas").getContext("2d");
const UP = 11, DOWN = 4; // extent of a line of text above and below its baseline

class Room {
  constructor(width, height, edges) {
    Object.assign(this, { border: [4, 4, width - 4, height - 4], edges, taken: [] });
  }

  take(...box) {
    this.taken.push(box);
  }

  cost(box) {
    const apart = (other) => box[2] <= other[0] || other[2] <= box[0] || box[3] <= other[1] || other[3] <= box[1];
    const inside = (other) => other[0] <= box[0] && other[1] <= box[1] && box[2] <= other[2] && box[3] <= other[3];
    if (!inside(this.border) || !this.taken.every(apart)) return Infinity;
    return this.edges.filter((edge) => !apart(edge) && !inside(edge)).length;
  }

  place(text, starts) { // starts of the baseline, the best first; null if no position is free
    INK.font = getComputedStyle(byId("map")).font.replace(/[\d.]+px/, "12.5px");
    const width = INK.measureText(text).width + 4, most = starts(width);
    const boxes = most.map(([x, y]) => [x - 2, y - UP, x + width - 2, y + DOWN]), costs = boxes.map((box, k) => this.cost(box) + k / 10);
    const best = costs.indexOf(Math.min(...costs));
    if (costs[best] === Infinity) return null;
    this.take(...boxes[best]);
    return most[best];
  }
}

function inBody([left, top, right, bottom]) { // inside from the top down, then beside the body
  return (width) => {
    const rows = [];
    for (let y = top + UP + 3; y + DOWN < bottom; y += 12) rows.push(y);
    const middle = (top + bottom) / 2 + DOWN;
    return [
      ...(left + width + 8 < right ? rows.flatMap((y) => [[left + 5, y], [right - width - 3, y]]) : []),
      [right + 5, middle], [left - width - 5, middle], [left, top - 6], [left, bottom + UP + 5],
    ];
  };
}

function atSensor([x, y]) { // beside the circle, then below and above, then further away
  return (width) => {
    const sides = (by) => [[x + 13, y + DOWN + by], [x - 11 - width, y + DOWN + by]];
    const further = Array.from({ length: 12 }, (_, k) => 8 * (k + 1)).flatMap((by) => [...sides(by), ...sides(-by)]);
    return [...sides(0), [x - width / 2, y + 24], [x - width / 2, y - 14], ...further];
  };
}

const short = (name) => (name.length > 24 ? `${name.slice(0, 23)}…` : name);

function view(sensors, [h, v], low, high, position) { // one view of the machine, with the same scale along both axes
  const drawn = bodies([h, v], position);
  const span = (places, ends) => [Math.min(...places, ...ends), Math.max(...places, ...ends)];
  const [h0, h1] = span(sensors.map((each) => 1e3 * each.place[h]), drawn.flatMap(({ box }) => [box[0], box[0] + box[2]]));
  const [v0, v1] = span(sensors.map((each) => 1e3 * each.place[v]), drawn.flatMap(({ box }) => [box[1], box[1] + box[3]]));
  const tall = drawn.length ? HEIGHT + 120 : HEIGHT, margin = drawn.length ? 30 : MARGIN;
  const scale = Math.min((WIDTH - 3.4 * MARGIN) / Math.max(h1 - h0, 1), (tall - 2 * margin) / Math.max(v1 - v0, 1));
  const x = (mm) => 1.4 * MARGIN + ((WIDTH - 3.4 * MARGIN) - scale * (h1 - h0)) / 2 + scale * (mm - h0);
  const y = (mm) => tall - margin - ((tall - 2 * margin) - scale * (v1 - v0)) / 2 - scale * (mm - v0);
  const svg = shape("svg", { viewBox: `0 0 ${WIDTH} ${tall}` }), axes = "XYZ";
  const outlines = drawn.map(({ box }) => [x(box[0]), y(box[1] + box[3]), x(box[0] + box[2]), y(box[1])]);
  const room = new Room(WIDTH, tall, outlines);
  svg.append(shape("rect", { x: 1, y: 1, width: WIDTH - 2, height: tall - 2, rx: 4 }));
  drawn.forEach(({ kind }, k) => {
    const [left, top, right, bottom] = outlines[k];
    svg.append(shape("rect", { x: left, y: top, width: right - left, height: bottom - top, rx: 2, class: `body ${kind}` }));
  });
  svg.append(shape("text", { x: WIDTH - 12, y: tall - 12, "text-anchor": "end", class: "axis" }, `${axes[h]} →`));
  svg.append(shape("text", { x: 12, y: 22, class: "axis" }, `↑ ${axes[v]}`));
  room.take(WIDTH - 40, tall - 26, WIDTH, tall);
  room.take(0, 0, 40, 28);
  const places = sensors.map((each) => [x(1e3 * each.place[h]), y(1e3 * each.place[v])]);
  for (const [cx, cy] of places) room.take(cx - 9, cy - 9, cx + 9, cy + 9);
  sensors.forEach((each, k) => {
    const [cx, cy] = places[k], value = each.flag || number(each.value, 1), text = `${short(each.name)} ${value}`;
    const shade = each.value === null ? "#ffffff" : SHADES[Math.round((SHADES.length - 1) * (each.value - low) / Math.max(high - low, 0.5))];
    const circle = shape("circle", { cx, cy, r: 8, fill: shade }), whole = room.place(text, atSensor(places[k]));
    const start = whole ?? room.place(value, atSensor(places[k]));
    circle.append(shape("title", {}, `${each.name} ${value}`));
    if (start && Math.abs(start[1] - cy) > 30) { // a line to a label that is not beside its circle
      svg.append(shape("line", { x1: cx, y1: cy, x2: start[0] > cx ? start[0] - 3 : cx - 13, y2: start[1] - DOWN, class: "lead" }));
    }
    svg.append(circle);
    if (start) svg.append(shape("text", { x: start[0], y: start[1], class: whole ? "sensor" : "value" }, whole ? text : value));
  });
  drawn.forEach(({ kind, name }, k) => {
    const start = name && room.place(name, inBody(outlines[k]));
    if (start) svg.append(shape("text", { x: start[0], y: start[1], class: `axis ${kind}-name` }, name));
  });
  return svg;
}

function map(temperatures, position) {
  const sensors = temperatures.filter((each) => each.place);
  byId("map-card").hidden = !sensors.length && !MACHINE;
  if (byId("map-card").hidden) return;
  const known = sensors.map((each) => each.value).filter((value) => value !== null);
  const low = Math.min(...known), high = Math.max(...known);
  const views = [[0, 2], [1, 2]].map((axes) => view(sensors, axes, low, high, position));
  byId("map").replaceChildren(...views);
  const named = Math.min(...views.map((each) => each.querySelectorAll(".sensor").length));
  const scheme = MACHINE ? " Schematic of the machine: the dashed frame is the travel, the head is at the present position of the axes." : "";
  const crowded = named < sensors.length ? " Names without enough space are shown when the pointer is on the circle." : "";
  byId("map-note").textContent = (known.length ? `Dark is ${number(low, 1)} °C, bright ${number(Math.max(high, low + 0.5), 1)} °C; white is unknown.` : sensors.length ? "All temperatures are unknown." : "The bench file states no positions of sensors.") + scheme + crowded;
}

async function values() {
  try {
    show(await answerOf("/now/values.json"));
    document.body.classList.remove("lost");
  } catch (error) {
    document.body.classList.add("lost");
    byId("clock").textContent = "The dashboard does not answer; the last known values are shown.";
  }
  setTimeout(values, INTERVAL);
}

const form = byId("history");
const INTERVALS = { 600: 2000, 3600: 5000, 28800: 20000 }; // ms between curves, by span
let drawn = null, asked = 0, timer = 0;

async function frame(names) { // the axes without data; replaced only if other quantities are selected
  const key = names.join("\n");
  if (drawn && drawn.key === key) return;
  const found = await answerOf(`/now/figure.json?${new URLSearchParams(names.map((name) => ["name", name]))}`);
  const place = element("div");
  place.id = `curves-${Date.now()}`;
  byId("curves").replaceChildren(place);
  if (drawn) {
    drawn.views.clear();
    Bokeh.documents.splice(Bokeh.documents.indexOf(drawn.document), 1);
  }
  const views = await Bokeh.embed.embed_item(sized(found.item), place.id);
  drawn = { key, views, document: Bokeh.documents.at(-1) };
}

async function curves() {
  clearTimeout(timer);
  const query = new URLSearchParams(new FormData(form));
  const names = query.getAll("name"), own = ++asked;
  byId("curves").hidden = !names.length;
  byId("history-note").textContent = names.length ? "" : "No quantity is selected.";
  try {
    if (names.length) {
      const found = await answerOf(`/now/history.json?${query}`);
      if (own !== asked) return;
      await frame(names);
      for (const [name, curve] of Object.entries(found)) { // local time, as at the machine
        const x = curve.x.map((t) => t - 60000 * new Date(t).getTimezoneOffset());
        drawn.document.get_model_by_name(name).data = { x, y: curve.y.map((y) => y ?? NaN) };
      }
      byId("curves").dataset.drawn = String(own);
    }
  } catch (error) {
    byId("history-note").textContent = error.name === "Error" ? error.message : "The dashboard does not answer.";
  }
  if (own === asked) timer = setTimeout(curves, INTERVALS[query.get("span")]);
}

form.addEventListener("input", curves);
form.addEventListener("submit", (event) => event.preventDefault());
values();
curves();
