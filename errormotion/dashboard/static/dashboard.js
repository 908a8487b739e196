// Figures controlled by a form: the server computes, BokehJS draws. Text from the server is only set as text.
"use strict";

function queryOf(form) {
  const query = new URLSearchParams();
  const home = [...form.querySelectorAll("[data-home]")].every((field) => field.value === field.dataset.home);
  for (const field of form.elements) {
    if (!field.name || (field.type === "checkbox" && !field.checked)) continue;
    if (field.dataset.home !== undefined) {
      if (!home) query.append(field.name, field.value);
    } else if (field.dataset.dim !== undefined) {
      query.append(field.name, `${field.dataset.dim}:${field.value}`);
    } else {
      query.append(field.name, field.value);
    }
  }
  return query;
}

function follow(form) {
  const target = document.getElementById(form.dataset.target);
  const note = document.getElementById(form.dataset.note);
  const link = document.getElementById(form.dataset.link);
  let number = 0, timer = 0, views = null;

  async function draw() {
    const own = ++number;
    if (form.querySelector("[type=checkbox][name=freedom]") && !form.querySelector("[name=freedom]:checked")) {
      note.textContent = "No freedom is selected.";
      return;
    }
    const query = queryOf(form);
    target.classList.add("waiting");
    try {
      const answer = await fetch(`${form.dataset.figure}?${query}`, { headers: { Accept: "application/json" } });
      const found = await answer.json();
      if (own !== number) return;
      if (!answer.ok) throw new Error(found.error);
      const drawn = document.createElement("div");
      drawn.id = `${target.id}-${own}`;
      target.replaceChildren(drawn);
      const before = views;
      views = await Bokeh.embed.embed_item(sized(found.item), drawn.id);
      if (before) before.clear?.();
      const place = (found.point || []).map((each) => each.toLocaleString("en", { maximumFractionDigits: 4 }));
      note.textContent = form.querySelector("[data-home]") && place.length && !found.point.includes(null) ? `At the functional point X ${place[0]}, Y ${place[1]}, Z ${place[2]} mm.` : "";
      const space = document.getElementById("space");
      if (space && own > 1) space.src = `${space.dataset.base}?${query}`;
      if (link) link.href = `${link.dataset.base}?${query}`;
      target.dataset.drawn = String(own);
    } catch (error) {
      if (own === number) note.textContent = error instanceof TypeError ? "The dashboard does not answer." : error.message;
    } finally {
      if (own === number) target.classList.remove("waiting");
    }
  }

  form.addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(draw, 300); });
  form.addEventListener("submit", (event) => { event.preventDefault(); draw(); });
  form.querySelector("#home")?.addEventListener("click", () => {
    for (const field of form.querySelectorAll("[data-home]")) field.value = field.dataset.home;
    draw();
  });
  draw();
}

for (const form of document.querySelectorAll("form[data-figure]")) follow(form);
