// Adding of files on the page "Results": the server reads them, this page shows tables and questions. Text is only set as text.
"use strict";

const answers = {};
let key = "", known = "", asked = 0;

const post = (path, body) => answerOf(path, { body, limit: 0, stay: true });

function complain(error) {
  byId("adding-wrong").textContent = error ? error.message : "";
  byId("adding-wrong").hidden = !error;
}

function busy(is) {
  for (const id of ["files", "draft-save", "draft-cancel"]) byId(id).disabled = is;
  byId("adding").setAttribute("aria-busy", String(is));
}

async function doing(work) {
  busy(true);
  complain();
  try {
    await work();
  } catch (error) {
    complain(error);
  } finally {
    busy(false);
  }
}

async function chosen(files) {
  await doing(async () => {
    await forget();
    for (const name of Object.keys(answers)) delete answers[name];
    for (const file of files) {
      const query = new URLSearchParams({ key, name: file.name, changed: file.lastModified });
      ({ key } = await post(`/results/add/file?${query}`, file));
    }
    await show();
  });
}

async function forget() {
  const old = key;
  key = "";
  if (old) await post("/results/add/cancel", { key: old, answers: {} }).catch(() => {}); // gone, or removed later
}

async function show() {
  const own = ++asked;
  const found = await post("/results/add/table.json", { key, answers });
  if (own !== asked) return;
  byId("draft").hidden = false;
  byId("draft-kind").textContent = found.kind;
  ({ known } = found);
  const run = element("a", known);
  run.href = `/run?${new URLSearchParams({ run: known })}`;
  byId("draft-known").replaceChildren("These files are in the record already, as the run ", run, ". Nothing is changed there; with what is stated here they can be added once more, as another run.");
  byId("draft-known").hidden = !known;
  byId("draft-save").textContent = known ? "Add once more" : "Add as a run";
  byId("draft-tables").replaceChildren(...found.tables.flatMap(tableOf));
  byId("draft-questions").replaceChildren(...found.questions.map(questionOf));
  byId("draft-notes").replaceChildren(...found.notes.map((each) => element("li", each)));
}

function tableOf(each, number) {
  const frame = element("div", undefined, "scroll"), table = element("table"), head = element("thead"), body = element("tbody");
  const title = [each.path, each.sheet && `sheet ${each.sheet}`, `${each.count} rows`].filter(Boolean).join(", ");
  table.append(element("caption", title), head, body);
  const titles = element("tr"), meanings = element("tr");
  for (const name of each.titles) {
    const cell = element("th", name);
    cell.scope = "col";
    titles.append(cell);
  }
  for (const meaning of each.meanings) meanings.append(element("td", meaning.replace(/\.\?$/, "") || "not used", meaning ? "meaning" : "soft"));
  head.append(titles, meanings);
  for (const row of each.rows) {
    const line = element("tr");
    for (const cell of row) line.append(element("td", cell, "number"));
    body.append(line);
  }
  frame.append(table);
  frame.tabIndex = 0;
  frame.setAttribute("role", "region");
  frame.setAttribute("aria-label", title);
  const names = each.titles.filter((name, k) => name && each.titles.indexOf(name) === k);
  const correctable = each.keys.map((own, k) => [own, each.meanings[k], each.titles[k]])
    .filter(([own, , name]) => own && names.includes(name));
  if (!correctable.length) return [frame];
  const more = element("details");
  more.append(element("summary", "Correct the columns"));
  correctable.forEach(([own, meaning, name], k) => {
    const choices = names.map((value) => ({ value, text: value }));
    const field = fieldOf(`column-${number}-${k}`, meaning, choices, name, true);
    field.querySelector("select").addEventListener("change", (event) => changed(own, event.target.value));
    more.append(field);
  });
  more.open = correctable.some(([own]) => own in answers);
  return [frame, more];
}

function fieldOf(id, label, choices, value, needed) {
  const row = element("div", undefined, "field"), name = element("label", label);
  let input;
  if (choices.length) {
    input = element("select");
    if (!needed || !value) input.append(new Option("", ""));
    for (const each of choices) input.append(new Option(each.text.startsWith(each.value) ? each.text : `${each.value}: ${each.text}`, each.value));
  } else {
    input = element("input");
    input.placeholder = needed ? "required" : "may be left empty";
    input.spellcheck = false;
  }
  input.id = id;
  input.value = value;
  input.required = needed;
  name.htmlFor = id;
  row.append(name, input);
  return row;
}

function questionOf(each, number) {
  const free = each.key === "machine"; // a machine may be new: the choices are suggestions
  const row = fieldOf(`question-${number}`, each.text, free ? [] : each.choices, each.proposed, each.needed);
  const input = row.querySelector("input, select");
  input.dataset.key = each.key;
  if (free && each.choices.length) {
    const list = element("datalist");
    list.id = "machines";
    for (const choice of each.choices) list.append(new Option(choice.value));
    input.setAttribute("list", list.id);
    row.append(list);
  }
  if (each.key === "raw" || each.key.startsWith("format.") || each.key === "attributes.axis")
    input.addEventListener("change", () => changed(each.key, input.value)); // other questions depend on it
  return row;
}

function typed() {
  const found = {};
  for (const input of byId("draft-questions").querySelectorAll("[data-key]")) found[input.dataset.key] = input.value.trim();
  return found;
}

function changed(name, value) {
  if (name === "raw" || name.startsWith("format.")) // the columns have other meanings then
    for (const each of Object.keys(answers)) if (!each.startsWith("format.")) delete answers[each];
  const old = answers[name];
  answers[name] = value;
  return doing(async () => {
    const before = typed();
    try {
      await show();
    } catch (error) { // a refused answer would be refused again with each other one
      if (old === undefined) delete answers[name];
      else answers[name] = old;
      throw error;
    }
    for (const input of byId("draft-questions").querySelectorAll("[data-key]"))
      if (before[input.dataset.key] && !input.value) input.value = before[input.dataset.key];
  });
}

byId("files").addEventListener("change", () => byId("files").files.length && chosen([...byId("files").files]));
const drop = byId("drop");
drop.addEventListener("dragover", (event) => {
  event.preventDefault();
  drop.classList.add("over");
});
drop.addEventListener("dragleave", () => drop.classList.remove("over"));
drop.addEventListener("drop", (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  if (event.dataTransfer.files.length) chosen([...event.dataTransfer.files]);
});
byId("draft").addEventListener("submit", (event) => {
  event.preventDefault();
  doing(async () => {
    const found = await post("/results/add/save", { key, answers: { ...typed(), ...answers }, again: Boolean(known) });
    if (found.known) { // added meanwhile
      await show();
      throw new Error("These files are in the record already, and were not added once more.");
    }
    location.assign(`/run?${new URLSearchParams({ run: found.run })}`);
  });
});
byId("draft-cancel").addEventListener("click", () => {
  byId("draft").hidden = true;
  byId("files").value = "";
  doing(forget);
});
