// The page "Token": the answer to the token has a second one, for control. It is kept for this address and port only.
"use strict";

document.querySelector("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target, refused = byId("refused");
  try {
    const found = await answerOf("/login", { body: { token: byId("token").value }, stay: true });
    localStorage.setItem(CONTROL, found.control);
    location.assign("/");
  } catch (error) {
    refused.textContent = error.message;
    refused.hidden = false;
    form.elements.token.select();
  }
});
