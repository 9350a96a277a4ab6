"use strict";

// The page: pictures with heat maps over them, and the keypoints picked in them. The server keeps the draft; every step
// is sent there, and what it answers is what is shown.

const TOKEN = new URLSearchParams(location.search).get("token") || "";
const N_OTHERS = 6;
const NEAR = 0.04; // of an image's width: a best match within this of the true place is right
const REACH = 11; // CSS pixels around a keypoint that grasp it
const COLOURS = [[10, 12, 18, 0.46], [87, 16, 110, 0.55], [188, 55, 84, 0.72], [249, 142, 9, 0.85], [252, 255, 164, 0.95]];

const IN_MEMORY = { willReadFrequently: true }; // as fast with a graphics card, and twice as fast without one

const $ = (id) => document.getElementById(id);
const state = { marks: [], can_undo: false, can_redo: false, is_saved: false, recordings: [] };
const views = [];
const heat = { at: null, scale: 1, middle: 1, sharpness: 6 };
let chosen = "";
let hovered = null; // {view, u, v}: under the pointer, or under the keyboard's cross
let dragged = null; // {name, view, u, v, has_moved}
let matches = { names: [], frames: new Map() };
let statusText = "";

// The server -----------------------------------------------------------------------------------------------------------

async function ask(name, body) {
  let answer;
  try {
    answer = await fetch(`/api/${name}`, {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Token": TOKEN },
      body: JSON.stringify(body || {}),
    });
  } catch {
    throw new Error("The command that served this page has ended. What was picked is kept: start it again.");
  }
  if (!answer.ok) {
    const said = await answer.json().catch(() => ({}));
    throw new Error(said.error || `refused (${answer.status})`);
  }
  return answer;
}

async function told(name, body) {
  return (await ask(name, body)).json();
}

// What went wrong stays long enough to be read, however soon the next heat maps come.
const COMPLAINT_MS = 4000;
let complainedAt = -COMPLAINT_MS;
function complain(error) {
  complainedAt = performance.now();
  show(error.message, true);
}

function show(text, isWrong = false) {
  // What was still under way when the page was finished has nowhere to tell it.
  if (text === statusText || !$("status")) return;
  statusText = text;
  $("status").textContent = text;
  $("status").classList.toggle("wrong", isWrong);
}

// Steps are sent one after the other: their order is what Undo goes back by.
let steps = Promise.resolve();
function edit(body) {
  const done = steps.then(async () => {
    const before = new Set(state.marks.map((mark) => mark.name));
    adopt(await told("edit", body));
    if (body.do === "add") choose(state.marks.map((mark) => mark.name).find((name) => !before.has(name)) || "");
    if (body.do === "rename") choose(body.new_name.trim());
  });
  steps = done.catch(complain);
  return steps;
}

function adopt(found) {
  Object.assign(state, found);
  if (!state.marks.some((mark) => mark.name === chosen)) chosen = "";
  renderList();
  askMatches();
  askHeat();
  draw();
}

// Views ----------------------------------------------------------------------------------------------------------------

class View {
  constructor(parent) {
    const root = $("view").content.cloneNode(true).firstElementChild;
    parent.append(root);
    Object.assign(this, { root, frame: null, picture: null, found: null, layer: blank(), backdrop: blank(), shown: "" });
    for (const name of ["recording", "camera", "swap", "frame"]) this[`${name}Field`] = root.querySelector(`.${name}`);
    this.canvas = root.querySelector("canvas");
    this.output = root.querySelector("output");
    this.recordingField.append(...groups());
    this.recordingField.onchange = () => this.show(opening(this.recordingField.value, 0.5));
    this.cameraField.onchange = () => this.show([this.frame[0], this.cameraField.value, this.frame[2]]);
    this.frameField.oninput = () => this.show([this.frame[0], this.frame[1], Number(this.frameField.value)]);
    this.swapField.onclick = () => this.swap();
    this.canvas.onpointerdown = (event) => this.press(event);
    this.canvas.onpointermove = (event) => this.over(event);
    this.canvas.onpointerup = (event) => this.release(event);
    this.canvas.onpointercancel = () => { dragged = null; draw(); };
    this.canvas.onpointerleave = () => { if (!dragged) hover(null); };
    this.canvas.onkeydown = (event) => this.key(event);
    this.canvas.onblur = () => { if (hovered && hovered.view === this) hover(null); };
    new ResizeObserver(() => draw()).observe(this.canvas);
  }

  get camera() { return cameraOf(this.frame); }

  async show(frame) {
    const camera = cameraOf(frame);
    frame = [frame[0], camera.name, Math.max(0, Math.min(frame[2], camera.n_frames - 1))];
    this.frame = frame;
    this.found = null;
    this.root.classList.remove("ready");
    this.recordingField.value = frame[0];
    this.cameraField.replaceChildren(...recordingOf(frame).cameras.map((one) => new Option(one.name)));
    this.cameraField.value = frame[1];
    this.cameraField.hidden = recordingOf(frame).cameras.length < 2;
    this.frameField.max = camera.n_frames - 1;
    this.frameField.value = frame[2];
    this.output.textContent = `${frame[2]}/${camera.n_frames - 1}`;
    this.canvas.setAttribute("aria-label", `${frame[0]}, ${frame[1]}, frame ${frame[2]}`);
    remember();
    try {
      const picture = await pictureOf(frame);
      if (this.frame !== frame) return;
      Object.assign(this, { picture, shown: "" });
      draw();
      await described(frame, () => this.frame === frame);
      if (this.frame !== frame) return;
      this.root.classList.add("ready");
      askHeat();
      askMatches();
    } catch (error) { complain(error); }
  }

  swap() {
    const [main] = views, mine = this.frame;
    this.show(main.frame);
    main.show(mine);
  }

  // Where the picture lies on the canvas, in CSS pixels.
  get place() {
    const { clientWidth, clientHeight } = this.canvas, { width, height } = this.camera;
    const zoom = Math.min(clientWidth / width, clientHeight / height);
    return { zoom, x: Math.round((clientWidth - zoom * width) / 2), y: Math.round((clientHeight - zoom * height) / 2) };
  }

  // Pixel centres are integers, so an image begins half a pixel before 0.
  toCanvas(u, v) {
    const { zoom, x, y } = this.place;
    return [x + zoom * (u + 0.5), y + zoom * (v + 0.5)];
  }

  toPixel(event) {
    const box = this.canvas.getBoundingClientRect(), { zoom, x, y } = this.place, { width, height } = this.camera;
    const u = (event.clientX - box.left - x) / zoom - 0.5, v = (event.clientY - box.top - y) / zoom - 0.5;
    const inside = u >= -0.5 && v >= -0.5 && u < width - 0.5 && v < height - 0.5;
    return { u: clamp(u, width), v: clamp(v, height), inside };
  }

  markAt(event) {
    const box = this.canvas.getBoundingClientRect();
    let best = "", least = REACH;
    for (const mark of state.marks) {
      if (!same(frameOf(mark), this.frame)) continue;
      const [x, y] = this.toCanvas(mark.u, mark.v);
      const away = Math.hypot(event.clientX - box.left - x, event.clientY - box.top - y);
      if (away < least) [best, least] = [mark.name, away];
    }
    return best;
  }

  press(event) {
    if (event.button !== 0) return;
    const at = this.toPixel(event), name = this.markAt(event);
    this.canvas.setPointerCapture(event.pointerId);
    if (name) choose(name);
    dragged = { name, view: this, ...at, x: event.clientX, y: event.clientY, hasMoved: false };
  }

  over(event) {
    const at = this.toPixel(event);
    if (dragged && dragged.view === this) {
      dragged.hasMoved ||= Math.hypot(event.clientX - dragged.x, event.clientY - dragged.y) > 3;
      if (dragged.name && dragged.hasMoved) Object.assign(dragged, { u: at.u, v: at.v });
    }
    this.canvas.style.cursor = this.markAt(event) ? "grab" : "crosshair";
    hover(at.inside || dragged ? { view: this, u: at.u, v: at.v } : null);
  }

  release() {
    const done = dragged;
    dragged = null;
    if (!done || done.view !== this) return;
    const at = { frame: this.frame, u: done.u, v: done.v };
    if (done.name && done.hasMoved) {
      const mark = state.marks.find((one) => one.name === done.name);
      if (mark) Object.assign(mark, { u: done.u, v: done.v }); // until the server has answered
      edit({ do: "move", name: done.name, at });
    } else if (!done.name && done.inside && !done.hasMoved) edit({ do: "add", at });
  }

  key(event) {
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const turns = { ",": -1, ".": 1, PageUp: -10, PageDown: 10 };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (moves[event.key]) this.nudge(...moves[event.key], event.shiftKey ? 10 : 1);
    else if (turns[event.key]) this.show([this.frame[0], this.frame[1], this.frame[2] + turns[event.key]]);
    else if (event.key === "Enter" || event.key === " ") {
      if (hovered && hovered.view === this) edit({ do: "add", at: { frame: this.frame, u: hovered.u, v: hovered.v } });
    } else return;
    event.preventDefault();
  }

  nudge(du, dv, by) {
    const { width, height } = this.camera, mark = state.marks.find((one) => one.name === chosen);
    if (mark && same(frameOf(mark), this.frame)) {
      Object.assign(mark, { u: clamp(mark.u + by * du, width), v: clamp(mark.v + by * dv, height) });
      settle(mark);
      hover({ view: this, u: mark.u, v: mark.v });
      return;
    }
    const from = hovered && hovered.view === this ? hovered : { u: (width - 1) / 2, v: (height - 1) / 2 };
    const step = by * Math.max(1, Math.round(width / 256));
    hover({ view: this, u: clamp(from.u + step * du, width), v: clamp(from.v + step * dv, height) });
  }
}

const blank = () => document.createElement("canvas");
const clamp = (value, size) => Math.max(0, Math.min(value, size - 1));
const same = (a, b) => a[0] === b[0] && a[1] === b[1] && a[2] === b[2];
const key = (frame) => frame.join("\n");
const frameOf = (mark) => [mark.recording, mark.camera, mark.frame];
const recordingOf = (frame) => state.recordings.find((one) => one.name === frame[0]);
const cameraOf = (frame) => recordingOf(frame).cameras.find((one) => one.name === frame[1]) || recordingOf(frame).cameras[0];

// Arrow keys come many a second: one step of Undo for all that belong together.
let settling = 0;
function settle(mark) {
  clearTimeout(settling);
  const { name, u, v } = mark, frame = frameOf(mark);
  settling = setTimeout(() => edit({ do: "move", name, at: { frame, u, v } }), 350);
}

function opening(name, share) {
  const camera = state.recordings.find((one) => one.name === name).cameras[0];
  return [name, camera.name, Math.round(share * (camera.n_frames - 1))];
}

function groups() {
  return [["Scans", "scene"], ["Demonstrations", "demonstration"]].map(([label, scope]) => {
    const group = document.createElement("optgroup");
    group.label = label;
    group.append(...state.recordings.filter((one) => one.scope === scope).map((one) => new Option(one.name)));
    return group;
  }).filter((group) => group.children.length);
}

// Pictures are kept as long as they are likely to be asked for again.
const pictures = new Map();
async function pictureOf(frame) {
  const name = key(frame);
  if (!pictures.has(name)) {
    const blob = await (await ask("picture", { frame })).blob();
    pictures.set(name, await createImageBitmap(blob));
    if (pictures.size > 60) pictures.delete(pictures.keys().next().value);
  }
  return pictures.get(name);
}

// One after the other: the network is busy with one at a time, and what nobody looks at any more need not be described.
let describing = Promise.resolve();
function described(frame, isWanted) {
  const done = describing.then(() => (isWanted() ? told("describe", { frame }) : null));
  describing = done.catch(() => null);
  return done;
}

// What resembles a recording most by its name is most likely of the same objects.
function suggested(main, turn) {
  const alike = (name) => { let i = 0; while (i < name.length && name[i] === main[0][i]) i++; return i; };
  const others = state.recordings.filter((one) => one.name !== main[0]);
  others.sort((a, b) => alike(b.name) - alike(a.name));
  const rotate = (list) => list.map((_, i) => list[(i + 2 * turn) % list.length]);
  const scans = rotate(others.filter((one) => one.scope === "scene"));
  const demonstrations = rotate(others.filter((one) => one.scope === "demonstration"));
  const cameras = recordingOf(main).cameras, first = cameras.indexOf(cameraOf(main)), shown = new Set([key(main)]);
  const shares = [0.37, 0.71, 0.18, 0.55, 0.9, 0.27].map((share) => (share + 0.13 * turn) % 1);
  // All cameras in turn; another frame than those already there, as long as there is one.
  const own = (i) => {
    const { name, n_frames } = cameras[(first + i + 1) % cameras.length], start = main[2] + 1 + Math.floor(shares[i] * (n_frames - 1));
    const tried = Array.from({ length: n_frames }, (_, more) => [main[0], name, (start + more) % n_frames]);
    const frame = tried.find((one) => !shown.has(key(one))) || tried[0];
    shown.add(key(frame));
    return frame;
  };
  const at = (one, i) => {
    const seen = one.cameras[i % one.cameras.length];
    return [one.name, seen.name, Math.round(shares[i % shares.length] * (seen.n_frames - 1))];
  };
  const frames = [own(0), own(1)], rest = [];
  for (let i = 0; i < Math.max(scans.length, demonstrations.length, 1); i++) {
    if (demonstrations[i]) rest.push(at(demonstrations[i], i));
    if (scans[i]) rest.push(at(scans[i], i));
  }
  for (let i = 2; rest.length < N_OTHERS - 2 && i < shares.length; i++) rest.push(own(i));
  return [...frames, ...rest].slice(0, N_OTHERS);
}

let turn = 0;
function shuffle() {
  turn += 1;
  suggested(views[0].frame, turn).forEach((frame, i) => views[i + 1].show(frame));
}

function remember() {
  if (views.length && views.every((view) => view.frame)) {
    sessionStorage.setItem("views", JSON.stringify(views.map((view) => view.frame)));
  }
}

function remembered() {
  try {
    const frames = JSON.parse(sessionStorage.getItem("views")) || [];
    return frames.length === N_OTHERS + 1 && frames.every((frame) => recordingOf(frame)) ? frames : null;
  } catch { return null; }
}

// Heat -----------------------------------------------------------------------------------------------------------------

// What is looked for: the point under the pointer, or else the chosen keypoint.
function wanted() {
  if (hovered) return { frame: hovered.view.frame, u: hovered.u, v: hovered.v };
  const mark = state.marks.find((one) => one.name === chosen);
  return mark ? { frame: frameOf(mark), u: mark.u, v: mark.v } : null;
}

function hover(at) {
  const touched = [hovered, at].filter((one) => one).map((one) => one.view);
  hovered = at;
  askHeat();
  draw(touched);
}

let isAsking = false, isStale = false;
async function askHeat() {
  const at = wanted();
  if (!at) {
    heat.at = null;
    views.forEach((view) => { view.found = null; });
    show(state.marks.length ? "" : "Move over a picture to see where else the network sees the same.");
    return draw();
  }
  // Only one request is under way: a pointer moves faster than answers come, and only its last place matters.
  if (isAsking) { isStale = true; return; }
  isAsking = true;
  try {
    const shown = views.filter((view) => view.frame), frames = shown.map((view) => view.frame);
    const answer = await ask("heat", { at, frames });
    takeHeat(await answer.arrayBuffer(), at, shown, frames);
  } catch (error) { complain(error); }
  isAsking = false;
  if (isStale) { isStale = false; askHeat(); }
}

function takeHeat(buffer, at, shown, frames) {
  if (!wanted()) return;
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  Object.assign(heat, { at, scale: header.scale, middle: header.middle });
  shown.forEach((view, i) => {
    const found = header.maps[i];
    if (!found) { if (view.frame === frames[i]) view.found = null; return; }
    const [height, width] = found.size, codes = new Uint8Array(buffer, offset, width * height);
    offset += width * height;
    if (view.frame === frames[i]) view.found = { ...found, width, height, codes, isDrawn: false };
  });
  tell(at, shown);
  draw();
}

function isRight(view) {
  const { best, place } = view.found;
  return Math.hypot(best[0] - place[0], best[1] - place[1]) <= NEAR * view.camera.width;
}

function tell(at, shown) {
  if (performance.now() - complainedAt < COMPLAINT_MS) return;
  const known = shown.filter((view) => view.found && view.found.place && !same(view.frame, at.frame));
  const right = known.filter(isRight).length;
  const where = `${at.frame[0]}, ${at.frame[1]} ${at.frame[2]}: ${Math.round(at.u)}, ${Math.round(at.v)}`;
  show(known.length ? `${where} · found again in ${right} of the ${known.length} views where its place is known` : where);
}

function likelihood(z) {
  return Math.exp((-heat.sharpness * z) / heat.middle);
}

function colourTable() {
  const table = new Uint32Array(256), bytes = new Uint8Array(table.buffer);
  for (let code = 0; code < 256; code++) {
    const position = likelihood(heat.scale * (code / 255) ** 2) * (COLOURS.length - 1), i = Math.min(Math.floor(position), COLOURS.length - 2);
    const mix = COLOURS[i].map((value, c) => value + (position - i) * (COLOURS[i + 1][c] - value));
    bytes.set([mix[0], mix[1], mix[2], 255 * mix[3]], 4 * code);
  }
  return table;
}

function layerOf(view, table) {
  const { width, height, codes, isDrawn } = view.found;
  if (!isDrawn) {
    Object.assign(view.layer, { width, height });
    const context = view.layer.getContext("2d", IN_MEMORY), image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    for (let i = 0; i < codes.length; i++) pixels[i] = table[codes[i]];
    context.putImageData(image, 0, 0);
    view.found.isDrawn = true;
  }
  return view.layer;
}

// Matches of all keypoints ---------------------------------------------------------------------------------------------

let isMatching = false, isUnmatched = false;
async function askMatches() {
  if (isMatching) { isUnmatched = true; return; }
  isMatching = true;
  try {
    const frames = views.filter((view) => view.frame).map((view) => view.frame);
    if (!state.marks.length || !$("show-matches").checked) matches = { names: [], frames: new Map() };
    else {
      const found = await told("matches", { frames });
      matches = { names: found.names, frames: new Map(frames.map((frame, i) => [key(frame), found.frames[i]])) };
    }
    draw();
  } catch (error) { complain(error); }
  isMatching = false;
  if (isUnmatched) { isUnmatched = false; askMatches(); }
}

// Drawing --------------------------------------------------------------------------------------------------------------

const due = new Set();
function draw(some = views) {
  if (!due.size) requestAnimationFrame(() => {
    const table = colourTable();
    for (const view of due) if (views.includes(view)) paint(view, table);
    due.clear();
  });
  for (const view of some) due.add(view);
}

function colourOf(name) {
  const i = state.marks.findIndex((mark) => mark.name === name);
  return `hsl(${(((0.09 + i * 0.618034) % 1) * 360).toFixed(1)} 95% ${(i >> 3) % 2 ? 74 : 62}%)`;
}

function paint(view, table) {
  const { canvas, picture } = view, ratio = devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d", IN_MEMORY);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  if (!view.frame || !picture) return;
  const { zoom, x, y } = view.place, wide = Math.round(zoom * view.camera.width), high = Math.round(zoom * view.camera.height);
  context.drawImage(backdropOf(view, wide * ratio, high * ratio), x, y, wide, high);
  if (view.found && $("show-heat").checked) context.drawImage(layerOf(view, table), x, y, wide, high);
  paintMatches(context, view);
  paintFound(context, view);
  paintMarks(context, view);
}

// The picture at the size it is shown in: scaling it well is dear, and it is drawn again with every move of the pointer.
function backdropOf(view, width, height) {
  const { backdrop, picture, frame } = view, shown = [...frame, width, height].join("\n");
  if (view.shown !== shown) {
    Object.assign(backdrop, { width, height });
    const context = backdrop.getContext("2d", IN_MEMORY);
    context.imageSmoothingQuality = "high";
    context.drawImage(picture, 0, 0, width, height);
    view.shown = shown;
  }
  return backdrop;
}

function ring(context, [x, y], radius, colour, width) {
  for (const [stroke, wide] of [["#000a", width + 2], [colour, width]]) {
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    Object.assign(context, { strokeStyle: stroke, lineWidth: wide });
    context.stroke();
  }
}

function paintMatches(context, view) {
  const found = matches.frames.get(key(view.frame));
  if (!found) return;
  matches.names.forEach((name, i) => {
    const mark = state.marks.find((one) => one.name === name);
    if (!mark || same(frameOf(mark), view.frame)) return;
    const [x, y] = view.toCanvas(found[i][0], found[i][1]);
    context.fillStyle = colourOf(name);
    context.strokeStyle = "#000b";
    context.lineWidth = 1.5;
    context.beginPath();
    context.arc(x, y, name === chosen ? 5 : 3.5, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
  });
}

function paintFound(context, view) {
  if (view.found && heat.at && !same(view.frame, heat.at.frame)) {
    const { best, place } = view.found, colour = !place ? "#fff" : isRight(view) ? "#5fd38d" : "#ff6b6b";
    // What is the least distance of all, but not small, is most likely no match.
    context.globalAlpha = 0.25 + 0.75 * Math.min(1, 2 * likelihood(view.found.z));
    ring(context, view.toCanvas(...best), 8, colour, 2);
    context.globalAlpha = 1;
    if (place && !isRight(view)) cross(context, view.toCanvas(...place), "#5fd38d", 5, true);
  }
  if (hovered && hovered.view === view && !(dragged && dragged.name)) {
    cross(context, view.toCanvas(hovered.u, hovered.v), "#fff", 9, false);
  }
}

function cross(context, [x, y], colour, size, isSlanted) {
  const gap = isSlanted ? 0 : 3;
  const ways = isSlanted ? [[0.7, 0.7], [-0.7, 0.7], [0.7, -0.7], [-0.7, -0.7]] : [[1, 0], [-1, 0], [0, 1], [0, -1]];
  for (const [stroke, width] of [["#000a", 4], [colour, 2]]) {
    context.beginPath();
    for (const [a, b] of ways) {
      context.moveTo(x + gap * a, y + gap * b);
      context.lineTo(x + (gap + size) * a, y + (gap + size) * b);
    }
    Object.assign(context, { strokeStyle: stroke, lineWidth: width });
    context.stroke();
  }
}

// The chosen one lies over the others. Of those, a name that would hide another keypoint is left to the list.
function paintMarks(context, view) {
  const placed = state.marks.filter((mark) => same(frameOf(mark), view.frame)).map((mark) => {
    const isDragged = dragged && dragged.name === mark.name && dragged.hasMoved;
    return { name: mark.name, at: isDragged ? view.toCanvas(dragged.u, dragged.v) : view.toCanvas(mark.u, mark.v) };
  });
  placed.sort((a, b) => (a.name === chosen) - (b.name === chosen));
  for (const { name, at: [x, y] } of placed) {
    const isChosen = name === chosen;
    context.beginPath();
    context.arc(x, y, isChosen ? 7 : 5.5, 0, 2 * Math.PI);
    context.fillStyle = colourOf(name);
    context.fill();
    ring(context, [x, y], isChosen ? 8 : 6.5, "#fff", isChosen ? 2.5 : 1.5);
    if (isChosen || view === views[0]) paintName(context, view, name, [x, y], placed);
  }
}

function paintName(context, view, name, [x, y], placed) {
  const isChosen = name === chosen;
  context.font = `${isChosen ? 600 : 500} 12px system-ui, sans-serif`;
  const wide = context.measureText(name).width, left = x + 14 + wide > view.canvas.clientWidth ? x - 18 - wide : x + 12;
  const hides = ({ at: [u, v] }) => u > left - 8 && u < left + wide + 18 && Math.abs(v - y) < 18;
  if (!isChosen && placed.some((one) => one.name !== name && hides(one))) return;
  context.fillStyle = isChosen ? "#0d0f14e6" : "#0d0f1499";
  context.beginPath();
  context.roundRect(left, y - 10, wide + 10, 20, 6);
  context.fill();
  context.fillStyle = "#fff";
  context.fillText(name, left + 5, y + 4);
}

// The list -------------------------------------------------------------------------------------------------------------

function choose(name) {
  if (chosen === name) return;
  chosen = name;
  renderList();
  askHeat();
  draw();
}

function renderList() {
  $("count").textContent = state.marks.length;
  $("empty").hidden = state.marks.length > 0;
  $("undo").disabled = !state.can_undo;
  $("redo").disabled = !state.can_redo;
  $("save").disabled = !state.marks.length || state.is_saved;
  document.title = `${state.marks.length && !state.is_saved ? "● " : ""}Keypoints ${$("title").textContent}`;
  if (document.activeElement && document.activeElement.classList.contains("name-field")) return;
  const focused = document.activeElement && document.activeElement.dataset && document.activeElement.dataset.name;
  $("list").replaceChildren(...state.marks.map(row));
  if (focused) (rowOf(focused) || { focus() {} }).focus();
  if (chosen && rowOf(chosen)) rowOf(chosen).scrollIntoView({ block: "nearest" });
}

const rowOf = (name) => [...$("list").children].find((one) => one.dataset.name === name);

function row(mark) {
  const line = document.createElement("li"), dot = document.createElement("span"), text = document.createElement("span");
  const where = document.createElement("span"), remove = document.createElement("button");
  line.dataset.name = mark.name;
  line.tabIndex = 0;
  line.classList.toggle("chosen", mark.name === chosen);
  dot.className = "dot";
  dot.style.background = colourOf(mark.name);
  text.className = "name";
  text.textContent = mark.name;
  where.className = "where";
  where.textContent = `${mark.recording} · ${mark.camera} ${mark.frame}`;
  text.append(where);
  remove.textContent = "✕";
  remove.title = "Delete";
  remove.setAttribute("aria-label", `Delete ${mark.name}`);
  remove.onclick = (event) => { event.stopPropagation(); edit({ do: "delete", name: mark.name }); };
  line.append(dot, text, remove);
  line.onclick = () => { choose(mark.name); goTo(mark); };
  line.ondblclick = () => rename(mark.name);
  line.onkeydown = (event) => {
    if (event.target !== line) return;
    if (event.key === "Enter") { choose(mark.name); goTo(mark); }
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      const next = event.key === "ArrowDown" ? line.nextElementSibling : line.previousElementSibling;
      if (next) { choose(next.dataset.name); rowOf(next.dataset.name).focus(); }
      event.preventDefault();
    }
  };
  return line;
}

function goTo(mark) {
  if (!views.some((view) => same(view.frame, frameOf(mark)))) views[0].show(frameOf(mark));
}

function rename(name) {
  const line = rowOf(name);
  if (!line) return;
  const field = document.createElement("input");
  Object.assign(field, { className: "name-field", value: name, maxLength: 40 });
  field.setAttribute("aria-label", "Name");
  line.querySelector(".name").replaceChildren(field);
  field.select();
  let isOver = false;
  const end = (isWanted) => {
    if (isOver) return;
    isOver = true;
    const given = field.value.trim();
    field.remove();
    renderList();
    (rowOf(name) || views[0].canvas).focus();
    if (isWanted && given && given !== name) edit({ do: "rename", name, new_name: given });
  };
  field.onclick = field.ondblclick = (event) => event.stopPropagation();
  field.onblur = () => end(true);
  field.onkeydown = (event) => {
    event.stopPropagation();
    if (event.key === "Enter") end(true);
    if (event.key === "Escape") end(false);
  };
}

// Commands -------------------------------------------------------------------------------------------------------------

async function save() {
  if (!state.marks.length || state.is_saved) return;
  $("save").disabled = true;
  show("saving …");
  await steps;
  try {
    const found = await told("save");
    adopt(found);
    $("saved-text").textContent = found.told;
    $("saved-next").textContent = found.next;
    $("saved").hidden = false;
    $("finish").focus();
    show("saved");
  } catch (error) {
    renderList();
    complain(error);
  }
}

async function finish() {
  await told("close").catch(() => null);
  views.length = 0;
  document.removeEventListener("keydown", onKey);
  document.body.replaceChildren(Object.assign(document.createElement("main"), { textContent: "Saved. This page can be closed." }));
}

function openProposals() {
  const scans = state.recordings.filter((one) => one.scope === "scene").map((one) => one.name);
  $("propose-scene").replaceChildren(...scans.map((name) => new Option(name)));
  if (scans.includes(views[0].frame[0])) $("propose-scene").value = views[0].frame[0];
  $("propose-go").disabled = !scans.length;
  $("propose-dialog").showModal();
}

async function propose() {
  if ($("propose-dialog").returnValue !== "yes") return;
  const scene = $("propose-scene").value, n = Number($("propose-n").value);
  $("propose").disabled = true;
  show(`looking for ${n} good points in ${scene} …`);
  try {
    adopt(await told("propose", { scene, n }));
    show("proposed; Undo takes them away");
    goTo(state.marks[state.marks.length - 1]);
  } catch (error) { complain(error); }
  $("propose").disabled = false;
}

function onKey(event) {
  if (event.target.matches("input:not([type=range]):not([type=checkbox]), select") || document.querySelector("dialog[open]")) return;
  const letter = event.key.toLowerCase();
  const flip = (id) => { $(id).checked = !$(id).checked; $(id).onchange(); };
  if (event.ctrlKey || event.metaKey) {
    if (letter === "z") edit({ do: event.shiftKey ? "redo" : "undo" });
    else if (letter === "y") edit({ do: "redo" });
    else if (letter === "s") save();
    else return;
  } else if (event.altKey) return;
  else if (event.key === "Delete" || event.key === "Backspace") { if (chosen) edit({ do: "delete", name: chosen }); }
  else if (event.key === "Escape") { choose(""); hover(null); }
  else if (event.key === "F2") { if (chosen) rename(chosen); }
  else if (event.key === "?") $("keys").showModal();
  else if (letter === "h") flip("show-heat");
  else if (letter === "m") flip("show-matches");
  else if (letter === "f") shuffle();
  else return;
  event.preventDefault();
}

async function start() {
  Object.assign(state, await told("start"));
  heat.sharpness = Number($("sharpness").value); // a reload keeps where it was set
  $("title").textContent = state.title;
  for (let i = 0; i <= N_OTHERS; i++) views.push(new View(i ? $("other-views") : $("main-view")));
  $("undo").onclick = () => edit({ do: "undo" });
  $("redo").onclick = () => edit({ do: "redo" });
  $("show-heat").onchange = draw;
  $("show-matches").onchange = askMatches;
  $("sharpness").oninput = () => {
    heat.sharpness = Number($("sharpness").value);
    views.forEach((view) => { if (view.found) view.found.isDrawn = false; });
    draw();
  };
  $("shuffle").onclick = shuffle;
  $("help").onclick = () => $("keys").showModal();
  $("propose").onclick = openProposals;
  $("propose-dialog").onclose = propose;
  $("save").onclick = save;
  $("go-on").onclick = () => { $("saved").hidden = true; };
  $("finish").onclick = finish;
  document.addEventListener("keydown", onKey);
  const main = state.marks.length ? frameOf(state.marks[0]) : opening(state.recordings[0].name, 0.5);
  const frames = remembered() || [main, ...suggested(main, 0)];
  views.forEach((view, i) => { view.frame = frames[i]; });
  views.forEach((view) => view.show(view.frame));
  renderList();
  askHeat();
}

start().catch(complain);
