"use strict";
// What the ground stations speak is spoken here too, and the phone stays awake while something runs.
const SPEAK_KEY = "aloud";
let spokenUpTo = null, awakeLock = null, waking = false;

function aloud(status) {
  keepAwake(status.progress !== null);
  const texts = status.spoken, latest = texts.length ? texts[texts.length - 1].number : 0;
  // What was said before this page looked, or before the daemon began anew, is no news.
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
// Browsers have it only where nobody in between can read along: https, or the board itself.
async function keepAwake(wanted) {
  if (!navigator.wakeLock || waking) return;
  if (!wanted && awakeLock) {
    awakeLock.release();
  } else if (wanted && !awakeLock && !document.hidden) {
    waking = true;
    try {
      awakeLock = await navigator.wakeLock.request("screen");
      awakeLock.addEventListener("release", () => { awakeLock = null; });
    } catch { /* the battery is low: the browser's to decide */ }
    waking = false;
  }
}
if (window.speechSynthesis) {
  const box = document.getElementById("aloud");
  try { box.checked = localStorage.getItem(SPEAK_KEY) === "1"; } catch { /* private window */ }
  document.getElementById("voice").hidden = false;
  box.addEventListener("change", () => {
    try { localStorage.setItem(SPEAK_KEY, box.checked ? "1" : "0"); } catch { /* likewise */ }
    // Phones let a page speak only once it has spoken at a touch.
    if (box.checked) speak("The companion speaks.");
    else speechSynthesis.cancel();
  });
}
