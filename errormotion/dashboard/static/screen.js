// Shared functions of the pages. On large screens figures have larger text and height, as pages have by their style.
"use strict";

const CONTROL = "errormotion-control"; // key of the token for control, which no other port or host has

const byId = (id) => document.getElementById(id);

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

// Send a request to the server; with a body by POST. A status of 403 leads to the login, since the dashboard may have been
// restarted with another token; not with stay, if the page contains input of the user.
async function answerOf(path, { body, limit = 10000, stay = false } = {}) { // body: a value for JSON, a form, or a file
  const options = { headers: { Accept: "application/json" }, signal: limit ? AbortSignal.timeout(limit) : undefined };
  if (body !== undefined) {
    const asIs = body instanceof URLSearchParams || body instanceof Blob;
    Object.assign(options, { method: "POST", body: asIs ? body : JSON.stringify(body) });
    if (!asIs) options.headers["Content-Type"] = "application/json";
    options.headers["X-Errormotion-Control"] = localStorage.getItem(CONTROL) ?? "";
  }
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("The dashboard does not answer.");
  }
  if (answer.status === 403 && !stay) location.assign("/login");
  const found = await answer.json();
  if (!answer.ok) throw new Error(found.error);
  return found;
}

const LARGE = matchMedia("(min-width: 2600px)").matches;

function sized(item) { // adapt the size of a figure for BokehJS before it is drawn
  if (!LARGE) return item;
  return JSON.parse(JSON.stringify(item), (key, value) => {
    if (key.endsWith("font_size") && /^\d+px$/.test(value)) return `${Math.round(1.55 * parseInt(value, 10))}px`;
    return key === "height" && typeof value === "number" ? 1.5 * value : value;
  });
}
