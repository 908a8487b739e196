// Figures have larger text and height on large screens, as the style sheet gives the page.
"use strict";

const LARGE = matchMedia("(min-width: 2600px)").matches;

function sized(item) { // of a figure for BokehJS, before it is drawn
  if (!LARGE) return item;
  return JSON.parse(JSON.stringify(item), (key, value) => {
    if (key.endsWith("font_size") && /^\d+px$/.test(value)) return `${Math.round(1.55 * parseInt(value, 10))}px`;
    return key === "height" && typeof value === "number" ? 1.5 * value : value;
  });
}
