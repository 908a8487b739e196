// The page "Measure": the server makes the form from the text of a campaign. Text is only set as text.
"use strict";

const INTERVAL = 1000, LIVE_INTERVAL = 3000; // ms
const text = byId("text"), control = Boolean(byId("processes-card").dataset.control);
let before = text.dataset.before, asked = 0, timer = 0, shown = "", planned = null;

const ask = (path, body) => answerOf(path, { body, limit: 0, stay: true });

function button(label, work, className) {
  const made = element("button", label, className);
  made.type = "button";
  made.addEventListener("click", work);
  return made;
}

// The form

const keyOf = (place) => JSON.stringify(place);

function fieldOf(each, number) {
  const row = element("div", undefined, "field"), id = `field-${number}`;
  const label = element("label", each.label);
  label.htmlFor = id;
  let input;
  if (each.choices.length) {
    input = element("select");
    if (!each.required || !each.text) input.append(new Option(each.required ? "" : `${each.default || "none"} (default)`, ""));
    for (const choice of each.choices) input.append(new Option(choice, choice));
  } else {
    input = element(each.text.length > 48 || each.text.startsWith("[") ? "textarea" : "input");
    input.placeholder = each.required ? "required" : each.default || (each.unit && `such as ${each.unit}`);
    input.spellcheck = false;
  }
  input.id = id;
  input.dataset.place = keyOf(each.place);
  input.addEventListener("change", () => changed(each.place, input.value));
  const wrong = element("p", "", "wrong"), meaning = element("p", each.meaning, "meaning");
  [wrong.id, meaning.id] = [`${id}-wrong`, `${id}-meaning`];
  input.setAttribute("aria-describedby", `${wrong.id} ${meaning.id}`);
  row.append(label, input, wrong, meaning);
  return row;
}

function fill(each) { // values and messages of the existing fields
  const input = document.querySelector(`[data-place="${CSS.escape(keyOf(each.place))}"]`);
  if (input !== document.activeElement || input.tagName === "SELECT" || !each.mistakes.length) input.value = each.text;
  const wrong = byId(`${input.id}-wrong`), message = each.mistakes.join("\n");
  wrong.textContent = message;
  wrong.hidden = !message;
  input.setAttribute("aria-invalid", message ? "true" : "false");
  if (message) input.closest("details")?.setAttribute("open", "");
}

function show(form) {
  const fields = form.groups.flatMap((group) => group.fields);
  const frame = JSON.stringify([form.groups.map((group) => group.test), fields.map((each) => [each.place, each.choices])]);
  if (frame !== shown && form.groups.length) {
    shown = frame;
    let number = 0;
    byId("form").replaceChildren(...form.groups.map((group, k) => {
      const card = element("fieldset", undefined, "group"), more = element("details"), rest = [];
      card.append(element("legend", group.title));
      for (const each of group.fields) {
        const row = fieldOf(each, number++);
        (k === 0 || each.text || each.mistakes.length || each.required ? card : { append: (made) => rest.push(made) }).append(row);
      }
      if (rest.length) {
        more.append(element("summary", `${rest.length} further settings`), ...rest);
        card.append(more);
      }
      if (group.test !== null) card.append(button(`Remove test ${group.test + 1}`, () => tests({ remove: group.test }), "remove"));
      card.append(element("ul", undefined, "mistakes"));
      return card;
    }));
  }
  form.groups.forEach((group, k) => {
    const card = byId("form").children[k];
    card.firstChild.textContent = group.title;
    card.lastChild.replaceChildren(...group.mistakes.map((each) => element("li", each)));
    group.fields.forEach(fill);
  });
  byId("mistakes").replaceChildren(...form.mistakes.map((each) => element("li", each)));
  byId("count").textContent = form.count ? `${form.count} ${form.count === 1 ? "mistake" : "mistakes"}` : "The campaign has no mistakes.";
  byId("count").className = form.count ? "count bad" : "count good";
  byId("plan").disabled = form.count > 0;
  ready();
}

function ready() {
  if (control) {
    byId("start").disabled = byId("plan").disabled || planned !== text.value;
    byId("start-note").hidden = !byId("start").disabled;
  }
  byId("plan-card").hidden = planned !== text.value;
}

function complain(error) {
  byId("wrong").textContent = error ? error.message : "";
  byId("wrong").hidden = !error;
}

async function check(change) {
  clearTimeout(timer);
  const own = ++asked;
  try {
    const found = await ask("/measure/form.json", { file: text.dataset.file, text: text.value, ...change });
    if (own !== asked) return;
    if (change) text.value = found.text;
    complain();
    show(found);
  } catch (error) {
    if (own === asked) complain(error);
  }
}

let queue = Promise.resolve(); // changes of fields are applied one after the other, each to the text after the previous one
function changed(place, value) {
  queue = queue.then(() => check({ place, value }));
}
function tests(change) { // add or remove a test; the form is replaced, and the new test gets the focus
  queue = queue.then(async () => {
    await check(change);
    if (change.add) byId("form").lastElementChild?.querySelector("input, select")?.focus();
  });
}
byId("add").addEventListener("click", () => tests({ add: true }));
text.addEventListener("input", () => {
  ready();
  clearTimeout(timer);
  asked++;
  timer = setTimeout(check, 400);
});

// The plan

function table(heads, rows) {
  const made = element("table"), head = element("tr");
  head.append(...heads.map((each, k) => Object.assign(element("th", each, k ? "number" : ""), { scope: "col" })));
  made.append(element("thead"), element("tbody"));
  made.tHead.append(head);
  made.tBodies[0].append(...rows.map((row) => {
    const line = element("tr");
    line.append(...row.map((each, k) => (k ? element("td", each, "number") : Object.assign(element("th", each), { scope: "row" }))));
    return line;
  }));
  return made;
}

function plan(test) {
  const card = element("section", undefined, "planned"), beside = element("div", undefined, "beside"), tables = element("div");
  card.append(element("h3", `${test.test} (${test.method})`), element("p", test.headline));
  if (test.limits.length) tables.append(element("h4", "Motions"), table(["", "planned", "limits"], test.limits));
  if (test.expected.length) tables.append(element("h4", "Largest expected uncertainty"), table(["", "U (k=2)", "unit"], test.expected));
  beside.append(tables);
  if (test.picture) beside.append(Object.assign(element("img"), { src: test.picture, alt: `Path of ${test.test} in three views, and the spindle speed over time; the extent is in the table` }));
  card.append(beside, ...test.notes.map((each) => element("p", each, "note")));
  return card;
}

byId("plan").addEventListener("click", async () => {
  const own = text.value;
  byId("plan").textContent = "Planning";
  try {
    const found = await ask("/measure/plan.json", { file: text.dataset.file, text: own });
    complain();
    byId("planned").replaceChildren(...found.tests.map(plan));
    planned = own;
    ready();
  } catch (error) {
    complain(error);
  } finally {
    byId("plan").textContent = "Show the plan";
  }
});

// Save and start

async function order(path, body) {
  try {
    const found = await ask(path, body);
    complain();
    return found;
  } catch (error) {
    complain(error);
    return null;
  }
}

// Motions of a real machine: nothing starts before the word that releases them was typed

let release = null; // repeats the order with the typed word

function askRelease(found, again) {
  release = again;
  byId("motions").replaceChildren(...found.motions.map((each) => element("li", each)));
  byId("word").textContent = found.word;
  byId("typed").value = "";
  byId("release-card").hidden = false;
  byId("release-card").scrollIntoView();
  byId("typed").focus();
}

function endRelease() {
  release = null;
  byId("release-card").hidden = true;
}

async function started(path, body, typed = "", motions = []) { // start or resume; returns the answer once a process was started
  const found = await ask(path, { ...body, release: typed, motions });
  if (found.process) {
    endRelease();
    return found;
  }
  askRelease(found, (word) => started(path, body, word, found.motions));
  return null;
}

if (control) {
  byId("release-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const again = release, typed = byId("typed").value;
    if (!again || !typed) return;
    endRelease();
    try {
      const found = await again(typed);
      if (found) taken(found);
      complain();
    } catch (error) {
      complain(error);
    }
    ready();
  });
  byId("unreleased").addEventListener("click", endRelease);
}

function taken(found) {
  before = found.before ?? before;
  reveal = found.process;
}

if (control) {
  byId("save").addEventListener("click", async () => {
    const found = await order("/measure/save", { file: byId("name").value, text: text.value, before });
    if (found) location.assign(`/measure?${new URLSearchParams({ file: found.file })}`);
  });
  byId("start").addEventListener("click", async () => {
    byId("start").disabled = true;
    try {
      const found = await started("/measure/start", { file: byId("name").value, text: text.value, before });
      complain();
      if (found) taken(found);
    } catch (error) {
      complain(error);
    }
    ready();
  });
}

// Processes

const WORDS = { finished: "✓ finished", interrupted: "■ stopped", failed: "✕ failed", killed: "✕ ended without a report" };
const cards = new Map();

async function command(path, body, pressed, send = ask) {
  pressed.disabled = true;
  try {
    await send(path, body);
    byId("refused").hidden = true;
  } catch (error) {
    byId("refused").textContent = error.message;
    byId("refused").hidden = false;
  }
  pressed.disabled = false;
}

function process(each) { // replaced only if more than the progress has changed, so that buttons keep the focus
  const { done, expected, note, ...rest } = each, key = JSON.stringify(rest);
  let card = cards.get(each.name);
  if (!card || card.dataset.key !== key) {
    const made = element("section", undefined, each.alive ? "card process alive" : "card process");
    made.dataset.key = key;
    made.dataset.process = each.name;
    const where = each.test ? `test ${each.number + 1} of ${each.total}, ${each.test}: ` : "";
    made.append(element("h3", `${each.campaign} on ${each.machine}`), element("p", `started ${new Date(each.started).toLocaleString("en-GB")}`, "note"));
    made.append(element("p", each.alive ? `${where}${each.stopping ? "stopping" : each.stage}` : WORDS[each.ended], `state ${each.ended || "live"}`));
    if (each.alive) {
      const bar = element("progress");
      bar.setAttribute("aria-label", "Progress of this stage");
      made.append(bar, element("p", "", "note course"));
      if (each.announcements.length) made.append(...each.announcements.map((line) => element("p", line, "note")));
    } else if (each.message) {
      made.append(element("p", each.message, "message"));
    }
    if (each.request) {
      const request = element("div", undefined, "request");
      request.setAttribute("role", "alert");
      request.append(element("p", each.request.text));
      if (control) request.append(button("Done", (event) => command("/measure/answer", { process: each.name, number: each.request.number }, event.target), "start"));
      made.append(request);
    }
    const links = element("p", undefined, "links");
    for (const test of each.tests) {
      if (test.status !== "finished") continue;
      const link = element("a", `Report of ${test.name}`);
      link.href = `/run?${new URLSearchParams({ run: test.run })}`;
      links.append(link, " ");
    }
    if (each.elsewhere) links.append(element("span", "It was started in a terminal or by another program; stop it there with Ctrl-C.", "note"));
    else if (control && each.alive) links.append(button("Stop", (event) => command("/measure/stop", { process: each.name }, event.target), "stop"));
    if (control && each.resume) links.append(button("Resume", (event) => command("/measure/resume", { run: each.resume }, event.target, started)));
    if (links.childNodes.length) made.append(links);
    if (card) card.replaceWith(made);
    cards.set(each.name, (card = made));
  }
  if (each.alive) {
    const bar = card.querySelector("progress"), part = expected > 0 && done !== null ? Math.min(done / expected, 1) : null;
    if (part === null) bar.removeAttribute("value");
    else bar.value = part;
    card.querySelector(".course").textContent = [part === null ? "" : `${Math.round(100 * part)} %`, note].filter(Boolean).join("  ");
  }
  return card;
}

let running = null, reveal = ""; // the run in progress, and the process that was just started on this page

async function processes() {
  try {
    const found = (await ask("/measure/processes.json")).processes;
    const names = new Set(found.map((each) => each.name));
    for (const name of cards.keys()) if (!names.has(name)) cards.delete(name);
    for (const [id, own] of [["processes", found.filter((each) => each.alive)], ["ended", found.filter((each) => !each.alive)]]) {
      const made = own.map(process), place = byId(id);
      if (made.length !== place.children.length || made.some((card, k) => place.children[k] !== card)) place.replaceChildren(...made);
      byId(`${id}-card`).hidden = !own.length;
    }
    if (names.has(reveal)) {
      byId("processes-card").scrollIntoView();
      reveal = "";
    }
    const now = found.find((each) => each.alive && each.measuring && each.tests.length);
    running = now ? now.tests.find((test) => test.name === now.test)?.run ?? null : null;
    document.body.classList.remove("lost");
  } catch (error) {
    document.body.classList.add("lost");
    byId("lost").textContent = error.message;
  }
  byId("lost").hidden = !document.body.classList.contains("lost");
  setTimeout(processes, INTERVAL);
}

let drawn = "", views = null;

async function live() { // the errors of the run in progress; the interval grows with the time of the computation
  const began = performance.now();
  if (running) {
    try {
      const run = running, found = await ask(`/measure/live.json?${new URLSearchParams({ run })}`);
      byId("live-card").hidden = false;
      byId("live-note").textContent = `${found.samples} samples. ${found.why ? `No errors yet: ${found.why}` : "Preliminary: from the samples so far, with U (k = 2)."}`;
      const key = `${run} ${found.samples}`;
      if (found.item && key !== drawn) {
        const place = element("div");
        place.id = `live-${Date.now()}`;
        const last = views;
        byId("live").replaceChildren(place);
        views = await Bokeh.embed.embed_item(sized(found.item), place.id);
        if (last) {
          last.clear?.();
          Bokeh.documents.splice(0, Bokeh.documents.length - 1);
        }
        drawn = key;
        byId("live").dataset.drawn = key;
      }
    } catch (error) {
      byId("live-note").textContent = error.message;
    }
  } else {
    byId("live-card").hidden = true;
  }
  setTimeout(live, Math.max(LIVE_INTERVAL, 4 * (performance.now() - began)));
}

check();
processes();
live();
