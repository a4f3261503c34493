"use strict";
// First-run set-up: shows the texts and questions of `companion setup`, and sends the answers back.
let asked = 0, ended = false;

function firstRun(found) {
  document.body.classList.toggle("setup", found !== null);
  $("setup").hidden = found === null;
  ended = found !== null && found.ended;
  if (found === null) return;
  $("vehicle").textContent = "companion setup";
  const told = found.lines.join("\n").trim();
  if ($("told").textContent !== told) {
    $("told").textContent = told;
    $("told").scrollTop = $("told").scrollHeight;
  }
  const question = found.question;
  $("answer").hidden = question === null;
  if (question === null || question.number === asked) return;
  asked = question.number;
  $("question").textContent = question.words;
  $("hint").textContent = question.more && question.more !== question.hint ? `${question.hint} ${question.more}` : question.hint;
  $("words").value = question.now;
  $("choices").replaceChildren(...question.choices.map(words => {
    const button = make("button", words);
    button.type = "button";
    button.addEventListener("click", () => reply(words));
    if (words === question.now) button.className = "now";
    return button;
  }));
  $("choices").classList.toggle("long", question.choices.some(words => words.length > 8));
  $("typed").hidden = question.choices.length > 0 && question.choices.every(words => ["yes", "no"].includes(words));
}
async function reply(words) {
  await act("answer", "answer", {number: asked, words});
}
document.getElementById("answer").addEventListener("submit", event => {
  event.preventDefault();
  reply($("words").value.trim());
});
