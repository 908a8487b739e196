// What the scripts of the pages share. Figures have larger text and height on large screens, as the page has by its style.
"use strict";

const byId = (id) => document.getElementById(id);

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

async function answerOf(path) { // the token may have changed: the dashboard was started again
  const answer = await fetch(path, { headers: { Accept: "application/json" }, signal: AbortSignal.timeout(10000) });
  if (answer.status === 403) location.assign("/login");
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer.json();
}

const LARGE = matchMedia("(min-width: 2600px)").matches;

function sized(item) { // of a figure for BokehJS, before it is drawn
  if (!LARGE) return item;
  return JSON.parse(JSON.stringify(item), (key, value) => {
    if (key.endsWith("font_size") && /^\d+px$/.test(value)) return `${Math.round(1.55 * parseInt(value, 10))}px`;
    return key === "height" && typeof value === "number" ? 1.5 * value : value;
  });
}
