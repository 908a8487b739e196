// The page "Compensate": requests states every second and curves every two. Text is only set as text.
"use strict";

const INTERVAL = 1000, CURVES = 2000; // ms

const number = (value, digits) => (value === null || value === undefined ? "—" : value.toFixed(digits).replace("-", "−"));
const signed = (value) => (value > 0 ? "+" : "") + number(value, 2);
const um = (value) => (value === null || value === undefined ? null : 1e6 * value);
const clock = (text) => new Date(text).toLocaleTimeString("en-GB");
const control = byId("stops").dataset.control === "1";
let chosen = byId("chosen").dataset.run, stops = "";

function cells(row, list) {
  for (const [text, className] of list) row.append(element("td", text, className));
  return row;
}

function stopButton(each) {
  const form = element("form", undefined, "order");
  form.method = "post";
  form.action = "/compensate/stop";
  const run = element("input");
  Object.assign(run, { type: "hidden", name: "run", value: each.key });
  const button = element("button", each.stopping ? "Ramping to zero" : "Stop: ramp to zero", "stop");
  button.type = "submit";
  button.setAttribute("aria-label", `${button.textContent}, ${each.machine}`);
  form.append(run, button);
  return form;
}

function showStops(list) { // replaced only after a change, so that a button stays under the pointer
  const working = list.filter((each) => each.working && each.machine !== undefined);
  const key = JSON.stringify(working.map((each) => [each.key, each.state, each.stopping]));
  if (key === stops) return;
  stops = key;
  byId("none").hidden = working.length > 0;
  byId("stops").replaceChildren(byId("none"), ...working.map((each) => {
    const bar = element("div", undefined, each.armed ? "at-work armed" : "at-work");
    bar.append(element("strong", each.machine), element("span", each.armed ? "armed: offsets are written" : "shadow mode: nothing is written"), element("span", each.state, "said"));
    bar.append(control ? stopButton(each) : element("span", `errormotion compensate stop RUNS/${each.key} ramps to zero`, "how"));
    return bar;
  }));
}

function showList(found) {
  byId("no-list").hidden = found.list.length > 0;
  byId("list").replaceChildren(...found.list.map((each) => {
    const row = element("tr"), name = element("th"), link = element("a", each.key);
    name.scope = "row";
    link.href = `/compensate?${new URLSearchParams({ run: each.key })}`;
    if (each.key === found.chosen?.key) link.setAttribute("aria-current", "true");
    name.append(link);
    row.append(name);
    const state = each.wrong || (each.working ? each.state : `ended: ${each.state ?? "unknown"}`);
    return cells(row, [[each.machine ?? "unknown"], [each.armed === undefined ? "unknown" : each.armed ? "armed" : "shadow"], [state]]);
  }));
  byId("starts").replaceChildren(...found.starts.filter((each) => each.code !== 0).map((each) => {
    const what = `${clock(each.time)} ${each.armed ? "armed" : "shadow"}, ${each.bench}, ${each.model}: `;
    const line = element("li", what + (each.code === null ? "the command runs." : `the command ended with code ${each.code}.`));
    if (each.printed) line.append(element("pre", each.printed));
    return line;
  }));
}

function alarms(found) {
  const { status, audit } = found, said = [];
  if (status.estop === true) said.push("Emergency stop of the machine");
  if (status.state === "fault") said.push(`Fault: ${status.cause}. The watchdog of the machine ramps its offset to zero.`);
  if (found.late) said.push(`The command is running, but has reported no state for ${number(found.late, 0)} s.`);
  if (!found.working && !status.ended) said.push("The command ended without an orderly stop. The watchdog of the machine ramps its offset to zero.");
  if (audit.broken) said.push(`Audit log: ${audit.broken}`);
  const key = said.join("\n");
  if (byId("alarms").dataset.key === key) return;
  byId("alarms").dataset.key = key;
  byId("alarms").replaceChildren(...said.map((text) => element("li", text)));
}

const UNITS = { spindle_speed: ["1/min", 1], feed: ["mm/min", 60e3] };

function showChosen(found) {
  byId("chosen").hidden = !found || Boolean(found.wrong);
  if (!found) return;
  if (found.wrong) {
    byId("alarms").replaceChildren(element("li", found.wrong));
    return;
  }
  const { status, audit } = found;
  alarms(found);
  const minutes = Math.floor(status.elapsed / 60);
  const program = status.program ? `, program ${status.program}` : "";
  byId("about").textContent = `${status.machine}: ${status.armed ? `armed, offsets are written by ${status.compensator}` : "shadow mode, nothing is written"}; ${found.working ? `running for ${minutes} min` : "ended"}, ${clock(status.time)}${program}`;
  for (const each of byId("states").children) {
    const here = each.dataset.state === status.state;
    each.className = here ? `here ${status.state}` : "";
    if (here) each.setAttribute("aria-current", "step"); else each.removeAttribute("aria-current");
  }
  byId("cause").textContent = status.cause ? `${status.state}: ${status.cause}` : "";
  byId("axes").replaceChildren(..."XYZ".split("").map((axis, k) => {
    const row = element("tr"), name = element("th", axis);
    name.scope = "row";
    row.append(name);
    const u = status.uncertainty[k];
    return cells(row, [
      [signed(um(status.predicted[k])), "number"], [number(u === null ? null : 2e6 * u, 2), "number soft"],
      [signed(um(status.offset[k])), "number strong"], [signed(status.applied ? um(status.applied[k]) : null), "number"],
      [number(1e6 * status.limits.limit, 0), "number soft"], [status.limited.includes(axis) ? "limited" : ""],
    ]);
  }));
  byId("zero").className = `cause-line ${found.zero ? "good" : ""}`;
  byId("zero").textContent = !status.armed ? "" : found.zero === null ? "The machine does not report the offset in effect."
    : found.zero ? "✓ The machine reports an offset of zero." : status.stopping ? "Ramping to zero: the machine has not reported an offset of zero yet." : "";
  byId("inputs").replaceChildren(...Object.entries(status.inputs).map(([input, value]) => {
    const [unit, factor] = UNITS[input] ?? ["°C", 1];
    const row = element("tr"), name = element("th", input);
    name.scope = "row";
    row.append(name);
    const wrong = status.missing.includes(input) ? "no recent reading" : status.doubtful.includes(input) ? "does not measure" : status.outside.some((each) => each.startsWith(input)) ? "outside the training range" : "";
    return cells(row, [[number(value === null ? null : factor * value, unit === "°C" ? 2 : 0), "number"], [unit], [wrong || "used", wrong ? "flagged" : "good"]]);
  }));
  const { limit, slew, period, oldest, uncertainty, hold, settle } = status.limits;
  const limits = [["each axis", `${+(1e6 * limit).toFixed(3)} µm`], ["change", `${+(1e6 * slew).toFixed(4)} µm/s`], ["period", `${period} s`], ["age of a reading", `${oldest} s`], ["U (k = 2)", `${+(1e6 * uncertainty).toFixed(3)} µm`], ["hold", `${hold} s`], ["settle", `${settle} s`]];
  byId("limits").replaceChildren(...limits.flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
  const unproved = !audit.keyed ? " This user has no key of it: others can compute the hashes anew." : !found.working && !audit.ended ? " It has no mark of an orderly end." : "";
  byId("chain").className = audit.broken ? "bad" : unproved ? "open" : "good";
  byId("chain").textContent = audit.broken ? "✕ The chain of hashes is broken."
    : audit.complete ? `${unproved ? "?" : "✓"} ${audit.entries} entries, the chain of hashes is unbroken.${unproved}` : `${audit.entries} entries checked so far.`;
  byId("hash").textContent = `Last hash ${audit.hash.slice(0, 16)}…, model ${audit.model.split(":").at(-1).slice(0, 16)}…, started ${audit.started}`;
  byId("log").replaceChildren(...found.rows.map((each) => {
    return cells(element("tr"), [[each.time.replace("T", " ").slice(0, 19), "time"], [each.what], [each.offset, "number"], [each.cause]]);
  }));
}

async function states() {
  try {
    const found = await answerOf(`/compensate/state.json?${new URLSearchParams({ run: chosen })}`);
    showStops(found.list);
    showList(found);
    showChosen(found.chosen);
    drawing = found.chosen && !found.chosen.wrong ? found.chosen.key : "";
    document.body.classList.remove("lost");
  } catch (error) {
    document.body.classList.add("lost");
    byId("alarms").dataset.key = "lost";
    byId("alarms").replaceChildren(element("li", "The dashboard does not answer; the last known state is shown. Compensations continue; Ctrl-C in their terminal or the emergency stop of the machine ends them."));
  }
  setTimeout(states, INTERVAL);
}

document.addEventListener("submit", async (event) => { // start and stop
  const order = event.target.closest("form.order");
  if (!order) return;
  event.preventDefault();
  try {
    const found = await answerOf(order.getAttribute("action"), { body: new URLSearchParams(new FormData(order)), limit: 60000 });
    location.assign(found.next);
  } catch (error) {
    byId("refused").textContent = error.message;
    byId("refused").hidden = false;
  }
});

const form = byId("history");
let drawing = "", figure = null, asked = 0, timer = 0;

async function frame() {
  if (figure) return;
  const found = await answerOf("/compensate/figure.json");
  const place = element("div");
  place.id = "curves-drawn";
  byId("curves").replaceChildren(place);
  await Bokeh.embed.embed_item(sized(found.item), place.id);
  figure = Bokeh.documents.at(-1);
}

async function curves() {
  clearTimeout(timer);
  const own = ++asked;
  try {
    if (drawing) {
      const query = new URLSearchParams(new FormData(form));
      query.set("run", drawing);
      const found = await answerOf(`/compensate/curves.json?${query}`);
      if (own !== asked) return;
      await frame();
      for (const [axis, data] of Object.entries(found)) { // local time, as at the machine
        const known = Object.fromEntries(Object.entries(data).map(([name, values]) => [name, values.map((value) => value ?? NaN)]));
        known.x = known.x.map((t) => t - 60000 * new Date(t).getTimezoneOffset());
        figure.get_model_by_name(axis).data = known;
      }
      byId("curves-note").textContent = found.X.x.length ? "" : "No offset has been decided yet.";
      byId("curves").dataset.drawn = String(own);
    }
  } catch (error) {
    byId("curves-note").textContent = error.name === "Error" ? error.message : "The dashboard does not answer.";
  }
  if (own === asked) timer = setTimeout(curves, drawing && figure ? CURVES : 300);
}

form.addEventListener("input", curves);
form.addEventListener("submit", (event) => event.preventDefault());
const machine = byId("machine");
if (machine) {
  const arming = () => {
    const armed = document.querySelector("[name=mode]:checked").value === "armed";
    machine.disabled = !armed;
    machine.required = armed;
    byId("arming").classList.toggle("unused", !armed);
  };
  for (const each of document.querySelectorAll("[name=mode]")) each.addEventListener("change", arming);
  arming();
}
states();
curves();
