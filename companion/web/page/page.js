"use strict";
const DEG_H = Math.PI / 180 / 3600, MG = 9.80665e-3;
const HOLD_MS = 1500, GONE_MS = 3000, AGAIN_MS = 1000, SLIP_PX = 80, DRAWN_MS = 10000;
const $ = id => document.getElementById(id);
let token = null, handedOut = false, source = null, heardAt = 0, triedAt = 0, page = null, shownRecords = null, counted = {}, busy = false;

function make(tag, text, className) {
  const it = document.createElement(tag);
  if (text !== undefined) it.textContent = text;
  if (className) it.className = className;
  return it;
}
function sign(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const use = document.createElementNS("http://www.w3.org/2000/svg", "use");
  use.setAttribute("href", "#" + name);
  svg.append(use);
  return svg;
}
const fixed = (value, digits, unit) => value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−") + unit;
const signed = (value, digits) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(digits);
const ago = s => s < 99.5 ? Math.round(s) + " s ago" : s < 5970 ? Math.round(s / 60) + " min ago" : (s / 3600).toFixed(1) + " h ago";
const utc = iso => iso.slice(0, 16).replace("T", " ") + " UTC";

// Commands in texts of the daemon, and the buttons of this page that do the same.
const BUTTONS = new Map([...document.querySelectorAll("button.hold, #cancel")].map(it =>
  [it.dataset.name || it.id, it.querySelector("span").firstChild.textContent]));
const COMMANDS = new RegExp("(type )?(`?)companion (" + [...BUTTONS.keys()].sort((a, b) => b.length - a.length).join("|")
  + ")( --write)?\\2(?![\\w-]| --)", "gi");
function inPageWords(text) {
  const press = (_, type, quote, command, write) => {
    const verb = command === "cancel" ? "tap " : "hold ";
    return (type ? (type[0] === "T" ? verb[0].toUpperCase() + verb.slice(1) : verb) : "") + BUTTONS.get(command) + (write ? " with WRITE ticked" : "");
  };
  return text.replace(COMMANDS, press).replace("type `companion status`", "look at this page")
    .replace(" (--write does)", ": tick WRITE before the start").replaceAll("`", "");
}

// --- display

function headline(tone, word, text) {
  const reason = inPageWords(text);
  $("head").dataset.tone = tone;
  document.querySelector("#word use").setAttribute("href", "#" + tone);
  const span = document.querySelector("#word span");
  const whole = word.replace(" %", "\u00a0%");
  if (span.textContent !== whole) span.textContent = whole;
  if ($("reason").textContent !== reason) $("reason").textContent = reason;
  document.title = word + " – companion";
  document.body.classList.toggle("gone", tone === "gone");
}
function show(status) {
  headline(status.headline.tone, status.headline.word, status.headline.reason);
  $("remedy").hidden = !status.headline.remedy;
  $("remedy").textContent = inPageWords(status.headline.remedy || "");
  firstRun(status.setup || null);
  if (status.setup) return;
  $("vehicle").textContent = status.vehicle.summary;
  busy = status.progress !== null;
  const away = !["disarmed", undefined].includes(status.vehicle.armed);
  $("head").classList.toggle("armed", status.headline.word === "ARMED");
  const aligns = status.stands !== null && status.stands.outcome === null;
  if (aligns !== document.body.classList.contains("aligning")) scrollTo(0, 0);
  document.body.classList.toggle("aligning", aligns);
  document.body.classList.toggle("blocked", status.headline.word === "WAITING" || status.headline.tone === "bad");
  $("progress").hidden = !busy;
  if (busy) document.querySelector("#progress div").style.width = status.progress + "%";
  quality(status);
  const pose = status.pose || {};
  $("pitch").textContent = fixed(pose.pitch_deg, 2, "°");
  $("roll").textContent = fixed(pose.roll_deg, 2, "°");
  $("heading").textContent = fixed(pose.heading_deg, 1, "°");
  $("north").textContent = pose.heading_deg != null ? "heading, " + pose.north : "heading";
  $("known").setAttribute("visibility", status.pose ? "visible" : "hidden");
  $("unknown").setAttribute("visibility", status.pose ? "hidden" : "visible");
  $("lost").hidden = status.pose !== null;
  document.querySelector("#pose svg").setAttribute("aria-label", status.pose ? "horizon" : "attitude not known");
  $("horizon").setAttribute("transform", `rotate(${-(pose.roll_deg || 0)}) translate(0 ${(pose.pitch_deg || 0) * 1.5})`);
  calibration(status.calibration, status.arming);
  const last = status.last, missed = last && last.state !== "done";
  $("last").hidden = !missed;
  if (missed) $("last").textContent = "the last one: " + inPageWords(last.reason.startsWith(last.state) ? last.reason : `${last.state}: ${last.reason}`);
  links(status);
  diagnosis(status.diagnosis, status.headline.reason, busy || away);
  byHand(status.by_hand, status.undoable);
  aloud(status);
  stands(status.stands, status);
  // Disable only buttons that make no sense: the daemon decides whether an action is allowed, and gives the reason.
  $("calibrate").disabled = busy || away;
  for (const button of document.querySelectorAll("#align button")) button.disabled = busy || away;
  const gradienter = status.devices.some(({name}) => name === "gradienter");
  for (const it of document.querySelectorAll(".wants-gradienter")) it.hidden = !gradienter;
  $("attitude").hidden = status.pose === null && !gradienter;
  $("cancel").disabled = !busy;
  $("undo").disabled = busy || away || status.why_no_undo !== null;
  const [step] = status.undoable;
  $("undoes").textContent = step && step.what || "hold 1.5 s";
  const key = JSON.stringify([status.last, status.headline.word === "READY", busy]);
  if (key !== shownRecords) { shownRecords = key; records(); }
}
// Configured targets that the active calibration has not reached, if its record shows what helps.
function quality(status) {
  const one = status.calibration && recordsRead.find(({record}) => record.started_at === status.calibration.started_at);
  const found = status.arming.quality, goals = {}, good = status.headline.tone === "good";
  const unmet = [["gyro", "deg/h", 1, "rad_s", DEG_H], ["accel", "mg", 2, "m_s2", MG]].filter(([triad]) => found[triad].met === false);
  for (const [triad, unit, digits, si, scale] of unmet) {
    const help = one && helps(one.record, triad, si, found[triad].sigma * scale, status.devices);
    if (help) (goals[help] ||= []).push(`${+found[triad].wanted.toFixed(digits)} ${unit}`);
  }
  const rows = Object.entries(goals).map(([help, wanted]) => `goal ${wanted.join(", ")} not met: ${help}`);
  $("quality").hidden = !good || !rows.length || status.headline.word === "ARMED";
  $("quality").textContent = rows.join("; ");
  $("head").classList.toggle("coarse", good && unmet.length > 0);
}
// What would lower the largest sigma in use, in rad/s or m/s^2; "" where its largest part is not known.
function helps(record, triad, si, sigma, devices) {
  const largest = (imu, kind) => Math.max(...imu[`${triad}_sigma_${kind}_${si}`] || [0]);
  const imu = record.imus.find(one => Math.abs((largest(one, "in_force") || largest(one, "use")) / sigma - 1) < 0.01);
  if (!imu) return "";
  const [warm, noise] = ["warm_up", "stat"].map(kind => largest(imu, kind) ** 2), rest = sigma ** 2 - warm - noise;
  if (warm > Math.max(noise, rest) || (imu.when_warm && imu.when_warm.words.length)) return "calibrate again when warm";
  if (noise > rest) return "set a larger calibration.max_s";
  const tilts = triad === "accel" && devices.some(({name}) => name === "gradienter");
  return tilts && !record.alignment ? "hold ZERO once" : "";
}
function axes(names, digits, biases, sigmas, unit, title, held, unchanged, before) {
  if (!biases) return [];
  const full = Math.max(...biases.map((bias, k) => Math.abs(bias) + sigmas[k])) * 1.08 || 1;
  const rows = names.map((name, k) => {
    const row = make("div", undefined, held ? "axis held" : "axis"), scale = make("div", undefined, "scale");
    const at = value => 50 + 50 * value / full;
    const bias = make("i", undefined, "bias"), sigma = make("i", undefined, "sigma");
    const [from, to] = [at(Math.min(0, biases[k])), at(Math.max(0, biases[k]))];
    bias.style.left = from + "%"; bias.style.width = to - from + "%";
    const half = 50 * sigmas[k] / full;
    sigma.style.left = `max(0%, calc(${at(biases[k]) - half}% - 2px))`; sigma.style.width = 2 * half + "%";
    scale.append(bias, make("i", undefined, "zero"), sigma);
    row.append(make("b", name), scale, make("b", `${signed(biases[k], digits)} ± ${sigmas[k].toFixed(digits)}`));
    return row;
  });
  const words = held ? [make("p", "held back: measured, not written; what was in force before still is", "note")] : [];
  if (before) {
    const most = Math.max(...biases.map((bias, k) => Math.abs(bias - before.bias[k])));
    const change = `${most.toFixed(digits)} ${unit.split(" ")[0]}`;
    words.push(make("p", unchanged ? `measured ${utc(before.at)}: ${change} off at most, too little to write`
      : `changed by ${change} at most since ${utc(before.at)}`, "note"));
  }
  return [make("h3", `${title}, ${unit}${held ? ", held back" : ""}`), ...words, ...rows];
}
const TRIADS = {gyro: ["gyro_bias_deg_h", "gyro_bias_rad_s", "residual_gyro_rad_s", DEG_H], accel: ["accel_bias_mg", "accel_bias_m_s2", "residual_accel_m_s2", MG]};
// Biases that the active offsets remove: an unchanged offset differs from the measured bias by the residual.
function active(found, imu, triad) {
  const [shown, , residual, unit] = TRIADS[triad];
  const one = recordsRead.find(({record}) => record.started_at === found.started_at)?.record.imus.find(({name}) => name === imu.name);
  if (!imu.unchanged.includes(triad) || !one || !one[residual]) return imu[shown];
  return imu[shown].map((bias, k) => bias - one[residual][k] / unit);
}
// Figures of the previous calibration, or of one that left the offsets unchanged, if its record has been read.
function earlier(found, {name, unchanged}, triad) {
  const at = recordsRead.findIndex(({record}) => record.started_at === found.started_at);
  if (at < 0) return null;
  const [, key, , unit] = TRIADS[triad];
  for (const {record} of recordsRead.slice(unchanged.includes(triad) ? at : at + 1)) {
    const imu = record.imus.find(imu => imu.name === name);
    if (record.state === "done" && !record.undone_at && imu && imu[key] && !imu.held_back.includes(triad)) {
      return {at: record.started_at, bias: imu[key].map(value => value / unit)};
    }
  }
  return null;
}
let shownBiases = null, recordsRead = [];
function calibration(found, arming) {
  if (!found) {
    $("age").textContent = arming.state === "uncalibrated" ? "none yet" : arming.in_force;
    $("imus").replaceChildren();
    shownBiases = null;
    return;
  }
  const words = [];
  if (found.calibrated_ago_s !== null) words.push("calibrated " + ago(found.calibrated_ago_s));
  else if (!found.in_force) words.push(utc(found.started_at) + ", before this start");
  if (found.confirmed_ago_s !== null) words.push("confirmed " + ago(found.confirmed_ago_s));
  for (const against of arming.against) words.push(against);
  $("age").textContent = words.join("; ");
  const key = JSON.stringify([found.imus, recordsRead.map(({file}) => file)]);
  if (key === shownBiases) return;
  shownBiases = key;
  $("imus").replaceChildren(...found.imus.flatMap(imu => {
    const warm = [];
    if (imu.temperature_degc !== null) warm.push(`at ${imu.temperature_degc.toFixed(1)} °C`);
    if (imu.temperature_now_degc !== null) warm.push(`now ${imu.temperature_now_degc.toFixed(1)} °C`);
    return [make("h3", `${imu.name}${warm.length ? ": " + warm.join(", ") : ""}`), ...imu.when_warm.map(words => make("p", words, "note")),
      ...axes(["x", "y", "z"], 1, active(found, imu, "gyro"), imu.gyro_sigma_deg_h, "°/h ± sigma", "gyro bias", imu.held_back.includes("gyro"),
        imu.unchanged.includes("gyro"), earlier(found, imu, "gyro")),
      ...axes(["x", "y", "z"], 2, active(found, imu, "accel"), imu.accel_sigma_mg, "mg ± sigma", "accelerometer bias", imu.held_back.includes("accel"),
        imu.unchanged.includes("accel"), earlier(found, imu, "accel"))];
  }));
}
let shownByHand = null;
function byHand(found, undoable) {
  const key = JSON.stringify([found, undoable]);
  if (key === shownByHand) return;
  shownByHand = key;
  const open = new Set([...document.querySelectorAll("#by-hand details[open]")].map(it => it.dataset.at));
  $("by-hand").replaceChildren(...found.map(one => {
    const rows = written(one, undoable), it = make(rows.length ? "details" : "p", undefined, "note");
    const end = one.undone_at ? `undone ${utc(one.undone_at)}` : one.in_force ? "active" : one.in_force === false ? "changed since" : "";
    const line = make(rows.length ? "summary" : "span", `: ${one.state === "failed" ? "failed: " : ""}${inPageWords(one.reason)}` + (rows.length && end ? `; ${end}` : ""));
    line.prepend(make("b", one.what.toUpperCase()), `, ${utc(one.measured_at)}`);
    it.append(line, ...rows.map(words => make("div", words)));
    it.dataset.at = one.measured_at;
    it.open = open.has(one.measured_at);
    return it;
  }));
}
function link(good, name, words, remedy) {
  const row = make("div", undefined, good ? "link" : "link bad"), text = make("div");
  text.append(make("b", name + " "), document.createTextNode(inPageWords(words)));
  if (remedy) text.append(make("p", inPageWords(remedy), "note"));
  row.append(sign(good ? "good" : "bad"), text);
  return row;
}
const FIXES = {gyros: "calibrates the gyros", accelerometers: "calibrates the accelerometers",
  "autopilot gyro calibration": "the autopilot calibrates its gyros"};
// Reasons of the autopilot against arming; the headline shows the first one.
function diagnosis(found, shown, held) {
  const fix = found.find(one => one.fix);
  $("diagnosis").hidden = !found.some(one => one.line !== shown) && !fix;
  $("refusals").replaceChildren(...found.filter(({line}) => line !== shown).map(one => link(false, "will not arm:", one.line, one.remedy)));
  $("fix").hidden = !fix;
  $("fix").disabled = held;
  if (fix) $("fixes").textContent = `hold 1.5 s; ${FIXES[fix.fix] || fix.fix}`;
}
// The daemon composes these rows; the command line shows the same ones.
function links(status) {
  $("links").replaceChildren(...status.rows.filter(([, name]) => name !== "will not arm").map(([verdict, name, words, remedy]) => link(verdict === "ok", name, words, remedy)));
}
async function records() {
  let found;
  try { found = (await (await fetch("/records.json")).json()).records; } catch { /* asked for again below */ }
  // A daemon that has just started may refuse: the next status asks again.
  if (!found) { shownRecords = null; return; }
  recordsRead = found;
  const open = new Set([...document.querySelectorAll("details[open]")].map(it => it.dataset.file));
  $("records").replaceChildren(...(found.length ? found.map(({file, record}) => {
    const it = make("details"), head = make("summary"), body = make("div"), get = make("a", "DOWNLOAD", "button");
    it.dataset.file = file;
    it.open = open.has(file);
    head.append(make("b", record.undone_at ? "undone" : record.state), document.createTextNode(` ${utc(record.started_at)}: ${inPageWords(record.reason)}`));
    body.append(make("p", `${Math.round(record.duration_s)} s` + (record.pose ? `; pitch ${fixed(record.pose.theta_deg, 2, "°")}, roll `
      + `${fixed(record.pose.gamma_deg, 2, "°")}, heading ${fixed(record.pose.psi_deg, 1, "°")}` : ""), "note"));
    for (const imu of record.imus) body.append(make("p", figures(imu, record.undone_at), "note"));
    for (const warning of record.warnings) body.append(make("p", "warning: " + inPageWords(warning), "note"));
    get.href = "/records/" + file;
    get.download = file;
    body.append(get);
    it.append(head, body);
    return it;
  }) : [make("p", "none yet", "note")]));
}
function figures(imu, undone) {
  const held = triad => (imu.held_back || []).includes(triad) ? " (held back, not written)" : "";
  const part = (bias, sigma, unit, digits, name, triad) => bias === null ? "" :
    ` ${name[0]}${held(triad)} ${bias.map((value, k) => `${signed(value / unit, digits)} ± ${(sigma[k] / unit).toFixed(digits)}`).join(", ")} ${name[1]};`;
  const written = Object.keys(imu.written).length;
  return `${imu.name}:` + part(imu.gyro_bias_rad_s, imu.gyro_sigma_in_force_rad_s || imu.gyro_sigma_use_rad_s, DEG_H, 1, ["gyro", "°/h"], "gyro")
    + part(imu.accel_bias_m_s2, imu.accel_sigma_in_force_m_s2 || imu.accel_sigma_use_m_s2, MG, 2, ["accelerometer", "mg"], "accel") + (written ? ` ${written} parameters written${undone ? ", then undone" : ""}` : "");
}
// The page's server draws the plots, as in reports, and only on request.
async function temperature() {
  const it = $("temperature");
  if (!it.open || document.hidden) return;
  try {
    const answer = await fetch("/temperature.html"), words = await answer.text();
    if (!answer.ok || words === shownTemperature) return;
    it.lastElementChild.replaceChildren(new DOMParser().parseFromString(words, "text/html").body.firstChild);
    shownTemperature = words;
  } catch { /* the headline shows that the daemon does not answer */ }
}
let shownTemperature = null;
$("temperature").addEventListener("toggle", temperature);
setInterval(temperature, DRAWN_MS);

// --- event stream

let refused = null; // reason why the server does not accept this viewer
function listen() {
  triedAt = Date.now();
  if (source) source.close();
  // A viewer with the token is accepted even if many viewers without it are connected.
  source = new EventSource("/events" + (token ? "?token=" + encodeURIComponent(token) : ""));
  source.addEventListener("hello", event => {
    const hello = JSON.parse(event.data);
    if (page !== null && page !== hello.page) {
      // Nothing more is shown before the reload: it would drop the finger of a button that seems alive.
      source.close();
      location.reload();
      return;
    }
    page = hello.page;
    handedOut = hello.token !== null;
    if (handedOut) token = hello.token;
    $("version").textContent = "companion " + hello.version;
    shownRecords = null;
  });
  source.addEventListener("refused", event => { refused = JSON.parse(event.data).reason; });
  source.onmessage = event => { heardAt = Date.now(); refused = null; show(JSON.parse(event.data)); };
  source.onerror = () => { source.close(); source = null; setTimeout(() => source || listen(), AGAIN_MS); };
}
let watchedAt = Date.now(), awakeAt = 0;
function watch() {
  const now = Date.now(), asleep = now - watchedAt > GONE_MS;
  watchedAt = now;
  if (now - heardAt < GONE_MS) return;
  // Browsers stop a page that nobody sees: that silence tells nothing about the companion.
  if (asleep) { awakeAt = now; listen(); }
  const silent = now - Math.max(heardAt, awakeAt);
  if (ended) { /* the set-up's page has closed: its last headline stays */ }
  else if (silent < GONE_MS) headline("gone", "RECONNECTING", "this page was asleep");
  else headline("gone", "NO LINK", refused || (heardAt ? `no word from the companion for ${Math.round(silent / 1000)} s: off, or out of range?`
    : "no word from the companion yet"));
  $("progress").hidden = $("remedy").hidden = true;
  for (const button of document.querySelectorAll("#keys button, #align button, #fix")) button.disabled = true;
  if (source && now - triedAt > (heardAt ? 2 : 5) * GONE_MS) listen();
}
setInterval(watch, 500);
document.addEventListener("visibilitychange", () => { if (!document.hidden) watch(); });

// --- actions

let saidTimer = 0;
function say(words, bad) {
  $("said").textContent = words;
  $("said").className = bad ? "bad" : "";
  $("said").hidden = false;
  clearTimeout(saidTimer);
  saidTimer = setTimeout(() => { $("said").hidden = true; }, 10000);
}
async function act(what, path, body) {
  if (!token) {
    $("ask").hidden = false;
    $("token").focus();
    say("buttons need the token: companion page, on the board, shows it", true);
    return;
  }
  say(what + ": asked for");
  try {
    const answer = await fetch("/" + path, {method: "POST", body: JSON.stringify(body),
      headers: {"Content-Type": "application/json", "X-Companion-Token": token}});
    const said = await answer.json();
    say(`${what}: ${inPageWords(said.reason)}`, !answer.ok || said.state === "failed");
    if (answer.status === 403 && !handedOut) $("ask").hidden = false;
  } catch { say(`${what}: no answer from the companion`, true); }
}
$("ask").addEventListener("submit", event => {
  event.preventDefault();
  token = $("token").value.trim();
  $("ask").hidden = true;
  if (token) { remember(token); say("now press again"); }
});
function remember(value) { try { localStorage.setItem("token", value); } catch { /* private window: remembered until it closes */ } }
if (location.hash.startsWith("#token=")) {
  token = decodeURIComponent(location.hash.slice(7));
  remember(token);
  history.replaceState(null, "", "/");
} else { try { token = localStorage.getItem("token"); } catch { /* none */ } }

for (const button of document.querySelectorAll("button.hold")) {
  const command = button.dataset.name || button.id, name = BUTTONS.get(command), path = command.split(" ")[0];
  let timer = 0, from = null;
  const stop = () => {
    if (timer) { clearTimeout(timer); timer = 0; say("hold " + name + " for 1.5 s", true); }
    button.classList.remove("held");
  };
  const start = () => {
    if (timer || button.disabled) return;
    button.classList.add("held");
    say("keep holding");
    timer = setTimeout(() => {
      timer = 0;
      button.classList.remove("held");
      if (button.disabled) { say(`${name}: not possible just now, hold it again`, true); return; }
      if (navigator.vibrate) navigator.vibrate(80);
      const body = JSON.parse(button.dataset.body || "{}");
      if ($("write").checked && ["faces", "turn", "compass"].includes(body.action) && !body.level) body.write = true;
      act(name + (body.write ? " with WRITE" : ""), path, body);
    }, HOLD_MS);
  };
  button.addEventListener("pointerdown", event => {
    if (event.button !== 0) return;
    button.setPointerCapture(event.pointerId);
    from = [event.clientX, event.clientY];
    start();
  });
  // A gloved finger rolls: only a large movement counts as releasing the button.
  button.addEventListener("pointermove", event => {
    if (from && Math.hypot(event.clientX - from[0], event.clientY - from[1]) > SLIP_PX) { from = null; stop(); }
  });
  for (const end of ["pointerup", "pointercancel", "blur"]) button.addEventListener(end, () => { from = null; stop(); });
  button.addEventListener("contextmenu", event => event.preventDefault());
  button.addEventListener("keydown", event => { if (!event.repeat && (event.key === "Enter" || event.key === " ")) start(); });
  button.addEventListener("keyup", stop);
}
// The buttons of an opened section lie below the bar.
$("align").addEventListener("toggle", () => { if ($("align").open) $("align").scrollIntoView(); });
$("cancel").addEventListener("click", () => act("CANCEL", "cancel", {}));
listen();
