"use strict";
// Speaks the texts that ground stations speak too, and keeps the phone awake while a job runs.
const SPEAK_KEY = "aloud";
let spokenUpTo = null, awakeLock = null, waking = false;

function aloud(status) {
  keepAwake(status.progress !== null);
  const texts = status.spoken, latest = texts.length ? texts[texts.length - 1].number : 0;
  // Do not speak texts from before this page was opened, or from before a restart of the daemon.
  if (spokenUpTo !== null && document.getElementById("aloud").checked) {
    for (const {number, text} of texts) if (number > spokenUpTo) speak(text);
  }
  spokenUpTo = latest;
}
function speak(text) {
  const words = new SpeechSynthesisUtterance(text);
  words.lang = "en";
  speechSynthesis.speak(words);
}
// Browsers offer the wake lock only over https, or on the board itself.
async function keepAwake(wanted) {
  if (!navigator.wakeLock || waking) return;
  if (!wanted && awakeLock) {
    awakeLock.release();
  } else if (wanted && !awakeLock && !document.hidden) {
    waking = true;
    try {
      awakeLock = await navigator.wakeLock.request("screen");
      awakeLock.addEventListener("release", () => { awakeLock = null; });
    } catch { /* the browser refuses, for example when the battery is low */ }
    waking = false;
  }
}
if (window.speechSynthesis) {
  const box = document.getElementById("aloud");
  try { box.checked = localStorage.getItem(SPEAK_KEY) === "1"; } catch { /* private window */ }
  document.getElementById("voice").hidden = false;
  box.addEventListener("change", () => {
    try { localStorage.setItem(SPEAK_KEY, box.checked ? "1" : "0"); } catch { /* private window */ }
    // Phones let a page speak only after it has spoken once in response to a touch.
    if (box.checked) speak("The companion speaks.");
    else speechSynthesis.cancel();
  });
}
