// Frames: their pictures, their descriptors, and suggestions for the other views.

// A frame of a recording's first camera, at a share of its duration.
function opening(name, share) {
  const camera = state.recordings.find((recording) => recording.name === name).cameras[0];
  return [name, camera.name, Math.round(share * (camera.n_frames - 1))];
}

// Option groups of the recordings: scans and demonstrations.
function groups() {
  return [["Scans", "scene"], ["Demonstrations", "demonstration"]].map(([label, scope]) => {
    const group = document.createElement("optgroup");
    group.label = label;
    const recordings = state.recordings.filter((recording) => recording.scope === scope);
    group.append(...recordings.map((recording) => new Option(recording.name)));
    return group;
  }).filter((group) => group.children.length);
}

// Cached pictures.
const MOST_PICTURES = 60; // 1.2 MB each at 640x480; a page shows at most nine
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

// Frames are described one after the other, as the network handles one at a time; those no longer shown are skipped.
let describing = Promise.resolve();
function described(frame, isWanted) {
  const done = describing.then(() => (isWanted() ? call("describe", { frame }) : null));
  describing = done.catch(() => null);
  return done;
}

// Frames for the other views. Recordings with similar names most likely show the same objects.
function suggested(main, turn) {
  const similarity = (name) => {
    let i = 0;
    while (i < name.length && name[i] === main[0][i]) i++;
    return i;
  };
  const others = state.recordings.filter((recording) => recording.name !== main[0]);
  others.sort((a, b) => similarity(b.name) - similarity(a.name));
  const rotate = (list) => list.map((_, i) => list[(i + 2 * turn) % list.length]);
  const scans = rotate(others.filter((recording) => recording.scope === "scene"));
  const demonstrations = rotate(others.filter((recording) => recording.scope === "demonstration"));
  const cameras = camerasOf(main);
  const first = cameras.indexOf(cameraOf(main));
  const shown = new Set([key(main)]);
  const shares = [0.37, 0.71, 0.18, 0.55, 0.9, 0.27, 0.45, 0.82].map((share) => (share + 0.13 * turn) % 1);
  // A frame of the same recording, its cameras in turn; none twice unless all are shown.
  const own = (i) => {
    const { name, n_frames } = cameras[(first + i + 1) % cameras.length];
    const start = main[2] + 1 + Math.floor(shares[i] * (n_frames - 1));
    const candidates = Array.from({ length: n_frames }, (_, more) => [main[0], name, (start + more) % n_frames]);
    const frame = candidates.find((candidate) => !shown.has(key(candidate))) || candidates[0];
    shown.add(key(frame));
    return frame;
  };
  const at = (recording, i) => {
    const camera = recording.cameras[i % recording.cameras.length];
    return [recording.name, camera.name, Math.round(shares[i % shares.length] * (camera.n_frames - 1))];
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

// Show other frames in the views beside the main one.
let turn = 0;
function shuffle() {
  turn += 1;
  suggested(views[0].frame, turn).forEach((frame, i) => views[i + 1].show(frame));
}

// Remember the shown frames across a reload.
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
