// Which frames are shown: their pictures, their descriptors, and which are suggested for the other views.

// A frame of a recording's first camera, at a share of its length.
function opening(name, share) {
  const camera = state.recordings.find((one) => one.name === name).cameras[0];
  return [name, camera.name, Math.round(share * (camera.n_frames - 1))];
}

// The recordings as options, scans apart from demonstrations.
function groups() {
  return [["Scans", "scene"], ["Demonstrations", "demonstration"]].map(([label, scope]) => {
    const group = document.createElement("optgroup");
    group.label = label;
    group.append(...state.recordings.filter((one) => one.scope === scope).map((one) => new Option(one.name)));
    return group;
  }).filter((group) => group.children.length);
}

// Pictures are kept as long as they are likely to be asked for again.
const MOST_PICTURES = 60; // 640x480 take 1.2 MB each; those of a page are seven
const pictures = new Map();
async function pictureOf(frame) {
  const name = key(frame);
  if (!pictures.has(name)) {
    const blob = await (await ask("picture", { frame })).blob();
    pictures.set(name, await createImageBitmap(blob));
    if (pictures.size > MOST_PICTURES) pictures.delete(pictures.keys().next().value);
  }
  return pictures.get(name);
}

// One after the other: the network is busy with one at a time, and what nobody looks at any more need not be described.
let describing = Promise.resolve();
function described(frame, isWanted) {
  const done = describing.then(() => (isWanted() ? call("describe", { frame }) : null));
  describing = done.catch(() => null);
  return done;
}

// What resembles a recording most by its name is most likely of the same objects.
function suggested(main, turn) {
  const alike = (name) => {
    let i = 0;
    while (i < name.length && name[i] === main[0][i]) i++;
    return i;
  };
  const others = state.recordings.filter((one) => one.name !== main[0]);
  others.sort((a, b) => alike(b.name) - alike(a.name));
  const rotate = (list) => list.map((_, i) => list[(i + 2 * turn) % list.length]);
  const scans = rotate(others.filter((one) => one.scope === "scene"));
  const demonstrations = rotate(others.filter((one) => one.scope === "demonstration"));
  const cameras = camerasOf(main);
  const first = cameras.indexOf(cameraOf(main));
  const shown = new Set([key(main)]);
  const shares = [0.37, 0.71, 0.18, 0.55, 0.9, 0.27, 0.45, 0.82].map((share) => (share + 0.13 * turn) % 1);
  // All cameras in turn; another frame than those already there, as long as there is one.
  const own = (i) => {
    const { name, n_frames } = cameras[(first + i + 1) % cameras.length];
    const start = main[2] + 1 + Math.floor(shares[i] * (n_frames - 1));
    const tried = Array.from({ length: n_frames }, (_, more) => [main[0], name, (start + more) % n_frames]);
    const frame = tried.find((one) => !shown.has(key(one))) || tried[0];
    shown.add(key(frame));
    return frame;
  };
  const at = (one, i) => {
    const seen = one.cameras[i % one.cameras.length];
    return [one.name, seen.name, Math.round(shares[i % shares.length] * (seen.n_frames - 1))];
  };
  const frames = [own(0), own(1)];
  const rest = [];
  for (let i = 0; i < Math.max(scans.length, demonstrations.length, 1); i++) {
    if (demonstrations[i]) rest.push(at(demonstrations[i], i));
    if (scans[i]) rest.push(at(scans[i], i));
  }
  for (let i = 2; rest.length < N_OTHERS - 2 && i < shares.length; i++) rest.push(own(i));
  return [...frames, ...rest].slice(0, N_OTHERS);
}

// Show other frames beside the main one.
let turn = 0;
function shuffle() {
  turn += 1;
  suggested(views[0].frame, turn).forEach((frame, i) => views[i + 1].show(frame));
}

// Keep the frames over a reload.
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
