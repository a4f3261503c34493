"use strict";
// Alignment: shows how to hold the aircraft, the progress of the pose and the finished poses, as the daemon reports.

const SVG = "http://www.w3.org/2000/svg";
// Outline of an aircraft in body axes (forward, right, down); "top" is the side that faces up when it is level.
const PARTS = [
  ...[[.14, 0], [0, .14], [-.14, 0], [0, -.14]].flatMap(([y, z], k, ring) => {
    const [y2, z2] = ring[(k + 1) % 4], side = z + z2 < 0 ? "top" : "under";
    return [["nose " + side, [[1, 0, 0], [.55, y, z], [.55, y2, z2]]],
      [side, [[.55, y, z], [-.95, y / 3, z / 3], [-.95, y2 / 3, z2 / 3], [.55, y2, z2]]]];
  }),
  ["wing", [[.3, 0, -.03], [.12, 1.05, -.03], [-.12, 1.05, -.03], [-.12, 0, -.03]]],
  ["wing", [[.3, 0, -.03], [-.12, 0, -.03], [-.12, -1.05, -.03], [.12, -1.05, -.03]]],
  ["wing", [[-.68, .42, 0], [-.92, .42, 0], [-.92, -.42, 0], [-.68, -.42, 0]]],
  ["fin", [[-.6, 0, 0], [-.88, 0, -.5], [-1, 0, -.5], [-.95, 0, 0]]],
];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const spherical = (azimuth, elevation) => [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
const AZIMUTH = -.95, ELEVATION = .38;
const EYE = spherical(AZIMUTH, ELEVATION), RIGHT = [-Math.sin(AZIMUTH), Math.cos(AZIMUTH), 0], TOP = spherical(AZIMUTH, ELEVATION + Math.PI / 2);

// Rotation from body axes to north, west, up. The aircraft heads north; the shortest turn from level brings `up` up.
function attitude(up) {
  const from = [up[0], -up[1], -up[2]], cosine = from[2];
  const axis = [from[1], -from[0], 0], sine = Math.hypot(axis[0], axis[1]);
  const about = sine > 1e-6 ? axis.map(value => value / sine) : [1, 0, 0];
  return ([x, y, z]) => {
    const point = [x, -y, -z], along = dot(about, point), aside = cross(about, point);
    return point.map((value, k) => value * cosine + aside[k] * sine + about[k] * along * (1 - cosine));
  };
}
function draw(tag, attributes) {
  const it = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) it.setAttribute(name, value);
  return it;
}
const onScreen = point => [60 * dot(point, RIGHT), -60 * dot(point, TOP)];
const path = points => "M" + points.map(point => onScreen(point).map(value => value.toFixed(1)).join(" ")).join("L");

// Picture of the aircraft in this pose above the ground, with an arrow if it has to be turned.
function picture(up, turnDeg, label) {
  const turned = attitude(up), svg = draw("svg", {role: "img", "aria-label": label, class: "hold"});
  const parts = PARTS.map(([name, points]) => [name, points.map(turned)]);
  const floor = Math.min(...parts.flatMap(([, points]) => points.map(point => point[2]))) - .12;
  const around = (radius, from, to) => Array.from({length: 25}, (_, k) => {
    const angle = from + (to - from) * k / 24;
    return [radius * Math.cos(angle), -radius * Math.sin(angle), floor];
  });
  const ring = around(1.1, 0, 2 * Math.PI), heights = [ring, ...parts.map(([, points]) => points)].flat().map(point => onScreen(point)[1]);
  svg.setAttribute("viewBox", `-78 ${(Math.min(...heights) + Math.max(...heights)) / 2 - 78} 156 156`);
  svg.append(draw("path", {class: "floor", d: path(ring) + "Z"}));
  const middle = points => points.reduce((sum, point) => sum + dot(point, EYE), 0) / points.length;
  for (const [name, points] of parts.sort(([, a], [, b]) => middle(a) - middle(b))) {
    const [a, b, c] = points.map(onScreen), seen = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0;
    svg.append(draw("path", {class: name === "wing" ? (seen ? "top" : "under") : name, d: path(points) + "Z"}));
  }
  if (turnDeg) {
    const arc = around(1.1, 0, turnDeg * Math.PI / 180), end = onScreen(arc[24]), before = onScreen(arc[22]);
    const angle = Math.atan2(end[1] - before[1], end[0] - before[0]) * 180 / Math.PI;
    svg.append(draw("path", {class: "arrow", d: path(arc)}),
      draw("path", {class: "head", d: "M9 0L-8 8V-8Z", transform: `translate(${end}) rotate(${angle})`}));
  }
  return svg;
}

const DISMISSED_KEY = "dismissed", END = {done: "DONE", failed: "FAILED", cancelled: "CANCELLED", undone: "UNDONE"};
let shownStands = null, shownEnd = "", dismissed = null;
function stands(found, status) {
  const running = found !== null && found.outcome === null;
  if (running) dismiss("");
  const ended = running ? null : end(found, status);
  shownEnd = ended ? ended.key : "";
  $("stands").hidden = found === null || (ended !== null && dismissed === ended.key);
  if ($("stands").hidden) return;
  const [first, why] = found.wish.split(/: (.*)/), [wish, grip] = first.split(/, (.*)/);
  const writing = running && ["writing", "verifying"].includes(status.state);
  $("still").textContent = found.share > 0 ? "" : found.objection || "";
  $("share").style.strokeDasharray = `${100 * found.share} 100`;
  $("now").classList.toggle("writing", writing);
  $("grip").textContent = writing ? status.reason
    : grip || why || (found.what === "faces" ? "propped up, hands off" : "");
  $("wish").textContent = writing ? "leave it as it is" : wish;
  const key = JSON.stringify([found.number, found.total, found.wish, found.done.length, ended]);
  if (key === shownStands) return;
  shownStands = key;
  const what = found.what.toUpperCase();
  $("standing").textContent = running ? `${what}: ${found.number} of ${found.total}` : ended.title;
  $("writes").textContent = !running || ["zero", "tilts"].includes(found.what) ? ""
    : found.write ? "will be written to the autopilot" : "will not be written: WRITE is not ticked";
  $("result").textContent = running ? "" : `${what}: ${ended.words}`;
  $("written").replaceChildren(...(running ? [] : ended.written.map(words => make("div", words))));
  $("stands").dataset.outcome = running ? "" : ended.outcome;
  $("how").replaceChildren(picture(found.hold.up, found.hold.turn_deg, wish));
  const left = Math.max(found.total - found.done.length, 0);
  $("done").replaceChildren(...found.done.map((up, k) => {
    const it = make("li");
    it.append(picture(up, 0, `pose ${k + 1}: done`), sign("good"));
    return it;
  }), ...Array.from({length: running ? left : 0}, (_, k) => make("li", String(found.done.length + k + 1))));
}
// How an alignment ended, and what has become of it since; `key` tells it from others that were dismissed.
function end(found, status) {
  if (found === null) return null;
  const one = status.by_hand.find(({what, reason}) => what === found.what && found.words.startsWith(reason));
  const outcome = one && one.undone_at ? "undone" : found.outcome;
  const title = END[outcome] + (outcome === "done" && ["faces", "tilts"].includes(found.what) ? ": put it down" : "");
  const words = outcome === "undone" ? "the old values are restored" : inPageWords(found.words);
  return {title, outcome, words, written: one && outcome !== "undone" ? written(one, status.undoable) : [], key: JSON.stringify([found.what, outcome, words])};
}
// Parameters that an alignment wrote; the old values are known as long as it can be undone.
function written(one, undoable) {
  const step = undoable.find(({at}) => at === one.measured_at), before = step ? step.before : {};
  const short = value => String(+value.toPrecision(6)).replace("-", "−");
  return Object.entries(one.written).map(([name, value]) => `${name} ${name in before ? short(before[name]) + " → " : ""}${short(value)}`);
}
function dismiss(key) {
  if (dismissed === key) return;
  dismissed = key;
  try { localStorage.setItem(DISMISSED_KEY, key); } catch { /* private window: shown again after a reload */ }
}
try { dismissed = localStorage.getItem(DISMISSED_KEY); } catch { /* none */ }
document.getElementById("dismiss").addEventListener("click", () => { dismiss(shownEnd); $("stands").hidden = true; });
