// Draws each .space of the page on a canvas: targets with their ellipsoids, the path of the sensor, its cameras.
// The numbers come from space.py and stand in the page. Coordinates: world (mm); in view, x right, y down, z away.
// Several on one page turn, zoom and step through the frames together.
"use strict";
const spaces = [];
for (const section of document.querySelectorAll(".space")) spaces.push(space(section));

function space(section) {
  const find = (selector) => section.querySelector(selector);
  const data = JSON.parse(find("script").textContent);
  const canvas = find("canvas"), tip = find(".tip"), slider = find("input"), readout = find("output");
  const magnifier = find("select"), pen = canvas.getContext("2d");
  const targets = data.targets, path = data.path, poses = path.frame.length;
  const STATES = ["provisional", "trusted", "quarantined"];
  const START = { yaw: -0.5, pitch: 0.35 };
  const VIEWS = { start: START, front: { yaw: 0, pitch: 0 }, above: { yaw: 0, pitch: Math.PI / 2 }, side: { yaw: -Math.PI / 2, pitch: 0 } };

  const at = (list, i) => [list[3 * i], list[3 * i + 1], list[3 * i + 2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const axes = [0, 1, 2].map((row) => at(data.axes, row));

  // --- what there is ------------------------------------------------------------------------------------------------

  const places = [];
  for (let i = 0; i < targets.id.length; i++) if (targets.state[i] === 1) places.push(at(targets.xyz, i));
  const ofTargets = places.length ? extent(places) : null;
  for (let k = 0; k < poses; k++) places.push(at(path.xyz, k));
  if (!places.length) for (let i = 0; i < targets.id.length; i++) places.push(at(targets.xyz, i));
  const whole = extent(places), reach = Math.max(whole.radius, 10);
  const cameraDepth = 0.16 * reach, step = roundStep(reach / 4);

  function extent(points) { // middle and radius, along the axes of the object
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const p of points) axes.forEach((axis, k) => {
      const value = dot(axis, p);
      low[k] = Math.min(low[k], value);
      high[k] = Math.max(high[k], value);
    });
    const along = axes.map((_, k) => (low[k] + high[k]) / 2);
    const middle = [0, 1, 2].map((k) => axes[0][k] * along[0] + axes[1][k] * along[1] + axes[2][k] * along[2]);
    return { middle, low, high, radius: Math.hypot(...axes.map((_, k) => high[k] - low[k])) / 2 };
  }

  function roundStep(value) { // 1, 2 or 5 times a power of ten
    const power = 10 ** Math.floor(Math.log10(value));
    return power * [1, 2, 5, 10].find((factor) => factor * power >= value);
  }

  function rotation(k) { // columns: right, down, forward of the sensor
    const down = at(path.down, k), forward = at(path.forward, k);
    return [cross(down, forward), down, forward];
  }

  function inWorld(k, p) {
    const [right, down, forward] = rotation(k);
    return plus(plus(plus(at(path.xyz, k), right, p[0]), down, p[1]), forward, p[2]);
  }

  // --- from where it is looked at -----------------------------------------------------------------------------------

  const view = { ...START, centre: whole.middle, zoom: 1 };
  let chosen = 0, hovered = null, magnify = data.magnify, colours = {}, width = 0, height = 0, waiting = false;
  let turn = [], away = 1, focal = 1;

  function look() {
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const x = plus(axes[0].map((v) => v * cy), axes[2], -sy), z = plus(axes[0].map((v) => v * sy), axes[2], cy);
    const y = axes[1];
    turn = [x, plus(y.map((v) => v * cp), z, -sp), plus(y.map((v) => v * sp), z, cp)];
    const least = Math.min(width, height);
    focal = 1.7 * least;
    away = focal * reach * 1.5 / (least * view.zoom);
  }

  function project(p) { // column, row, distance; null behind the eye
    const q = plus(p, view.centre, -1), z = dot(turn[2], q) + away;
    return z < 0.05 * away ? null : [width / 2 + focal * dot(turn[0], q) / z, height / 2 + focal * dot(turn[1], q) / z, z];
  }

  function ellipse(p, s, i) { // half axes (px) and angle of the silhouette of a magnified ellipsoid, J C J'
    const q = plus(p, view.centre, -1), z = s[2], f = focal / z;
    const rows = [0, 1].map((r) => plus(turn[r], turn[2], -dot(turn[r], q) / z).map((v) => v * f * magnify));
    const [a, b, c, d, e, g] = targets.cov.slice(6 * i, 6 * i + 6);
    const times = (v) => [a * v[0] + b * v[1] + c * v[2], b * v[0] + d * v[1] + e * v[2], c * v[0] + e * v[1] + g * v[2]];
    const uu = dot(rows[0], times(rows[0])), uv = dot(rows[0], times(rows[1])), vv = dot(rows[1], times(rows[1]));
    const mean = (uu + vv) / 2, off = Math.hypot((uu - vv) / 2, uv);
    return [Math.sqrt(mean + off), Math.sqrt(Math.max(mean - off, 0)), Math.atan2(2 * uv, uu - vv) / 2];
  }

  // --- drawing ------------------------------------------------------------------------------------------------------

  function readColours() {
    const style = getComputedStyle(section);
    for (const name of ["card", "ink", "faint", "grid", "good", "amber", "bad", "path", "mark"]) {
      colours[name] = style.getPropertyValue("--" + name).trim();
    }
    const ends = [colours.good, colours.amber, colours.bad].map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
    colours.ramp = Array.from({ length: 33 }, (_, i) => {
      const t = i / 16, [a, b] = t < 1 ? [ends[0], ends[1]] : [ends[1], ends[2]], u = t < 1 ? t : t - 1;
      return `rgb(${a.map((v, c) => Math.round(v + (b[c] - v) * u)).join(",")})`;
    });
  }

  const ofResidual = (um) => um < 0 ? colours.faint : colours.ramp[Math.round(32 * Math.min(um / 1000 / data.worst, 1))];

  function line(points, colour, thick, alpha = 1) {
    pen.globalAlpha = alpha;
    pen.strokeStyle = colour;
    pen.lineWidth = thick;
    pen.beginPath();
    points.forEach((p, i) => i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1]));
    pen.stroke();
    pen.globalAlpha = 1;
  }

  function segment(a, b, ...look) {
    const p = project(a), q = project(b);
    if (p && q) line([p, q], ...look);
  }

  function floor() { // a grid under it all, to tell what is near
    const first = [0, 2].map((k) => Math.floor(whole.low[k] / step) * step);
    const last = [0, 2].map((k) => Math.ceil(whole.high[k] / step) * step), depth = whole.high[1] + 0.05 * reach;
    const spot = (x, z) => [0, 1, 2].map((k) => axes[0][k] * x + axes[1][k] * depth + axes[2][k] * z);
    for (let x = first[0]; x <= last[0] + 1e-6; x += step) segment(spot(x, first[1]), spot(x, last[1]), colours.grid, 1);
    for (let z = first[1]; z <= last[1] + 1e-6; z += step) segment(spot(first[0], z), spot(last[0], z), colours.grid, 1);
  }

  function camera(k, colour, thick, isFilled) {
    for (const [index, [centre, corners]] of pyramids.entries()) {
      const tip = project(inWorld(k, centre));
      const rim = corners.map((corner) => project(inWorld(k, plus(centre, corner, cameraDepth))));
      if (!tip || rim.includes(null)) continue;
      if (isFilled) {
        pen.globalAlpha = 0.13;
        pen.fillStyle = colour;
        pen.beginPath();
        rim.forEach((p) => pen.lineTo(p[0], p[1]));
        pen.fill();
      }
      const strength = index ? 0.55 : 1;
      line([...rim, rim[0]], colour, thick, strength);
      rim.forEach((p) => line([tip, p], colour, thick, 0.7 * strength));
    }
  }

  function target(i, p, s) {
    const state = targets.state[i], isSeen = poses && path.targets[chosen].includes(i), isHovered = hovered && hovered.target === i;
    const near = Math.min(Math.max(away / s[2], 0.5), 1.8);
    const colour = isHovered ? colours.mark : state === 1 ? colours.good : state ? colours.bad : colours.faint;
    const size = (state === 1 ? 3.4 : 3) * Math.sqrt(near) * (width < 500 ? 0.85 : 1);
    pen.globalAlpha = Math.min(0.45 + 0.55 * near * near, 1);
    const [a, b, angle] = ellipse(p, s, i);
    if (state === 1 && a > size && a < 3 * width) {
      pen.save();
      pen.globalAlpha *= 0.16;
      pen.fillStyle = colour;
      pen.beginPath();
      pen.ellipse(s[0], s[1], a, Math.max(b, 0.5), angle, 0, 2 * Math.PI);
      pen.fill();
      pen.restore();
      pen.lineWidth = 0.8;
      pen.strokeStyle = colour;
      pen.stroke();
    }
    pen.fillStyle = pen.strokeStyle = colour;
    pen.lineWidth = 1.5;
    pen.beginPath();
    if (state === 2) {
      pen.moveTo(s[0] - size, s[1] - size);
      pen.lineTo(s[0] + size, s[1] + size);
      pen.moveTo(s[0] - size, s[1] + size);
      pen.lineTo(s[0] + size, s[1] - size);
      pen.stroke();
    } else {
      pen.arc(s[0], s[1], size, 0, 2 * Math.PI);
      state ? pen.fill() : pen.stroke();
    }
    pen.globalAlpha = 1;
    if (isSeen || isHovered) {
      pen.strokeStyle = isHovered ? colours.mark : colours.ink;
      pen.lineWidth = 1.4;
      pen.beginPath();
      pen.arc(s[0], s[1], size + 3.2, 0, 2 * Math.PI);
      pen.stroke();
    }
  }

  function place(tip) { // where something would help
    const s = project(tip.xyz), r = 8;
    if (!s) return;
    pen.beginPath();
    for (const [x, y] of [[0, -r], [r, 0], [0, r], [-r, 0]]) pen.lineTo(s[0] + x, s[1] + y);
    pen.closePath();
    pen.fillStyle = colours.mark;
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = colours.card;
    pen.stroke();
    pen.font = "600 10px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.fillStyle = "#fff";
    pen.fillText(tip.number, s[0], s[1] + 3.5);
    pen.textAlign = "start";
  }

  function label(k, words) {
    const s = project(at(path.xyz, k));
    if (!s) return;
    pen.font = "12px system-ui, sans-serif";
    pen.lineWidth = 3;
    pen.strokeStyle = colours.card;
    pen.strokeText(words, s[0] + 9, s[1] - 8);
    pen.fillStyle = colours.ink;
    pen.fillText(words, s[0] + 9, s[1] - 8);
  }

  function draw() {
    waiting = false;
    const scale = window.devicePixelRatio || 1;
    width = canvas.clientWidth;
    height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
    }
    look();
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineCap = pen.lineJoin = "round";
    floor();
    const things = []; // distance, then what: targets, and pieces of the path that end at a pose
    for (let i = 0; i < targets.id.length; i++) {
      const p = at(targets.xyz, i), s = project(p);
      if (s) things.push([s[2], () => target(i, p, s)]);
    }
    let before = null;
    for (let k = 0; k < poses; k++) {
      const s = project(at(path.xyz, k)), from = path.gap[k] ? null : before;
      before = s;
      if (!s) continue;
      const isAlone = !from && (k + 1 === poses || path.gap[k + 1]), near = Math.min(Math.max(away / s[2], 0.55), 1.7);
      if (from || isAlone) things.push([s[2], () => line([from || [s[0] - 0.5, s[1]], s], ofResidual(path.um[k]), 2.2 * near, Math.min(near, 1))]);
    }
    things.sort((a, b) => b[0] - a[0]).forEach(([, paint]) => paint());
    if (poses) {
      if (chosen) camera(0, colours.faint, 1, false);
      for (const i of path.targets[chosen]) segment(at(path.xyz, chosen), at(targets.xyz, i), colours.ink, 0.7, 0.4);
      camera(chosen, colours.ink, 1.5, true);
      if (chosen) label(0, "first");
      label(chosen, "frame " + path.frame[chosen]);
    }
    data.advice.forEach(place);
    if (hovered && hovered.pose !== undefined) {
      const s = project(at(path.xyz, hovered.pose));
      if (s) {
        pen.beginPath();
        pen.arc(s[0], s[1], 5.5, 0, 2 * Math.PI);
        pen.strokeStyle = colours.mark;
        pen.lineWidth = 2;
        pen.stroke();
      }
    }
  }

  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }

  // --- what is under the pointer, and what is chosen ----------------------------------------------------------------

  const mm = (p) => "(" + p.map((v) => v.toFixed(1)).join(", ").replaceAll("-", "−") + ") mm";
  const ofPose = (k) => `frame ${path.frame[k]}` + (path.um[k] < 0 ? "" : ` · residual ${(path.um[k] / 1000).toFixed(3)} mm`) +
    (path.targets[k].length ? ` · ${path.targets[k].length} targets` : "");

  function under(x, y) { // the target, or else the pose, nearest to the pointer
    let best = null, least = 12;
    for (let i = 0; i < targets.id.length; i++) {
      const s = project(at(targets.xyz, i)), d = s ? Math.hypot(s[0] - x, s[1] - y) : Infinity;
      if (d < least) [best, least] = [{ target: i, x: s[0], y: s[1] }, d];
    }
    if (best) return best;
    for (let k = 0; k < poses; k++) {
      const s = project(at(path.xyz, k)), d = s ? Math.hypot(s[0] - x, s[1] - y) : Infinity;
      if (d < least) [best, least] = [{ pose: k, x: s[0], y: s[1] }, d];
    }
    return best;
  }

  function hover(found) {
    const same = (a, b) => a === b || (a && b && a.target === b.target && a.pose === b.pose);
    if (!same(found, hovered)) redraw();
    hovered = found;
    tip.hidden = !found;
    if (!found) return;
    if (found.target !== undefined) {
      const i = found.target, [a, , , d, , g] = targets.cov.slice(6 * i, 6 * i + 6);
      const sigma = Math.sqrt(a + d + g) / 3, seen = targets.seen[i];
      tip.innerHTML = `<b>target ${targets.id[i]}</b> ${STATES[targets.state[i]]}<br>${mm(at(targets.xyz, i))}<br>` +
        `sigma ${sigma.toPrecision(2)} mm · seen ${seen} time${seen === 1 ? "" : "s"}`;
    } else {
      tip.innerHTML = `<b>${ofPose(found.pose)}</b><br>${mm(at(path.xyz, found.pose))}`;
    }
    const left = Math.min(found.x + 14, width - tip.offsetWidth - 6), top = found.y + 16;
    tip.style.left = Math.max(left, 6) + "px";
    tip.style.top = (top + tip.offsetHeight > height ? found.y - tip.offsetHeight - 12 : top) + "px";
  }

  function choose(k, isTold) {
    chosen = Math.min(Math.max(k, 0), poses - 1);
    if (!isTold) others((other) => other.follow(path.frame[chosen]));
    slider.value = chosen;
    slider.setAttribute("aria-valuetext", ofPose(chosen));
    readout.textContent = ofPose(chosen);
    redraw();
  }

  function follow(frame) { // the last pose up to that of another run
    const after = path.frame.findIndex((each) => each > frame);
    if (poses) choose(after < 0 ? poses - 1 : after - 1, true);
  }

  function others(tell) {
    for (const each of spaces) if (each.section !== section) tell(each);
  }

  function move(change, isTold) {
    if (!isTold) others((other) => other.move({ ...change, x: 0, y: 0 }, true));
    if (change.yaw) view.yaw += change.yaw;
    if (change.pitch) view.pitch = Math.min(Math.max(view.pitch + change.pitch, -Math.PI / 2), Math.PI / 2);
    if (change.x || change.y) {
      const size = away / focal; // of a pixel at the centre (mm)
      view.centre = plus(plus(view.centre, turn[0], -(change.x || 0) * size), turn[1], -(change.y || 0) * size);
    }
    if (change.zoom) view.zoom = Math.min(Math.max(view.zoom * change.zoom, 0.2), 60);
    tip.hidden = true;
    hovered = null;
    redraw();
  }

  // --- hands --------------------------------------------------------------------------------------------------------

  const held = new Map(); // pointers that are down, where they were last
  let travelled = 0;

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.offsetX, event.offsetY]);
    travelled = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId), now = [event.offsetX, event.offsetY];
    if (!last) return hover(under(...now));
    const x = now[0] - last[0], y = now[1] - last[1];
    travelled += Math.hypot(x, y);
    if (held.size === 2) { // two fingers: pinch, and pan by half of what each moves
      const [other] = [...held].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
      const apart = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
      move({ x: x / 2, y: y / 2, zoom: apart(now) / apart(last) });
    } else if (event.shiftKey || event.buttons === 2 || event.buttons === 4) move({ x, y });
    else move({ yaw: 0.008 * x, pitch: 0.008 * y });
    held.set(event.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => {
    held.delete(event.pointerId);
    if (end === "pointercancel" || travelled > 5) return;
    const found = under(event.offsetX, event.offsetY);
    if (found && found.pose !== undefined) choose(found.pose);
    hover(found);
  });
  canvas.addEventListener("pointerleave", () => hover(null));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // the page scrolls on
    event.preventDefault();
    move({ zoom: Math.exp(-0.0015 * event.deltaY) });
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step) move(event.shiftKey ? { x: 20 * step[0], y: 20 * step[1] } : { yaw: 0.08 * step[0], pitch: 0.08 * step[1] });
    else if (event.key === "+" || event.key === "=") move({ zoom: 1.15 });
    else if (event.key === "-") move({ zoom: 1 / 1.15 });
    else if (event.key === "." || event.key === ",") choose(chosen + (event.key === "." ? 1 : -1));
    else if (event.key === "0" || event.key === "Home") show("start");
    else return;
    event.preventDefault();
  });

  function show(name, isTold) {
    if (!isTold) others((other) => other.show(name, true));
    const around = name === "targets" && ofTargets ? ofTargets : whole;
    Object.assign(view, VIEWS[name], { centre: around.middle, zoom: reach / Math.max(around.radius, 0.02 * reach) });
    move({}, true);
  }

  for (const button of section.querySelectorAll("button")) button.addEventListener("click", () => show(button.value));
  const pyramids = data.cameras.map((each) => [each.slice(0, 3), [0, 1, 2, 3].map((corner) => each.slice(3 + 3 * corner, 6 + 3 * corner))]);
  slider.addEventListener("input", () => choose(Number(slider.value)));
  magnifier.addEventListener("change", () => {
    magnify = Number(magnifier.value);
    redraw();
  });
  magnifier.value = String(magnify);
  slider.max = Math.max(poses - 1, 0);
  section.querySelector(".scrub").hidden = !poses;
  section.querySelector(".spacing").textContent = `grid ${step} mm`;
  section.hidden = false;
  readColours();
  if (poses) choose(0, true);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    readColours();
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  return { section, move, show, follow };
}
