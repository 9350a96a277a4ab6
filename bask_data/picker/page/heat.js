// Heat maps of the point under the pointer, and matches of all keypoints.

const NEAR = 0.04; // of an image's width: a best match within this of the true place is right. The radius of a ring on a
// view of 200 pixels; counts of right ones depend on it about in proportion for networks that are still being trained.
const COLOURS = [[10, 12, 18, 0.46], [87, 16, 110, 0.55], [188, 55, 84, 0.72], [249, 142, 9, 0.85], [252, 255, 164, 0.95]];
const heat = { at: null, scale: 1, middle: 1, sharpness: 6 };

// What is looked for: the point under the pointer, or else the chosen keypoint.
function wanted() {
  if (hovered) return { frame: hovered.view.frame, u: hovered.u, v: hovered.v };
  const mark = markOf(chosen);
  return mark ? { frame: frameOf(mark), u: mark.u, v: mark.v } : null;
}

// Set what the pointer is over, {view, u, v} or null.
function hover(at) {
  const touched = [hovered, at].filter((one) => one).map((one) => one.view);
  hovered = at;
  askHeat();
  draw(touched);
}

// Ask for the heat maps of what is looked for, in all views that are shown.
let isAsking = false;
let isStale = false;
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
    const shown = shownViews();
    const frames = shown.map((view) => view.frame);
    const answer = await ask("heat", { at, frames });
    takeHeat(await answer.arrayBuffer(), at, shown, frames);
  } catch (error) { complain(error); }
  isAsking = false;
  if (isStale) { isStale = false; askHeat(); }
}

// Take the server's heat maps: the length of a JSON text, the text, and a byte a pixel of each map.
function takeHeat(buffer, at, shown, frames) {
  if (!wanted()) return;
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  Object.assign(heat, { at, scale: header.scale, middle: header.middle });
  shown.forEach((view, i) => {
    const found = header.maps[i];
    if (!found) { if (view.frame === frames[i]) view.found = null; return; }
    const [height, width] = found.size;
    const codes = new Uint8Array(buffer, offset, width * height);
    offset += width * height;
    if (view.frame === frames[i]) view.found = { ...found, width, height, codes, isDrawn: false };
  });
  tell(at, shown);
  draw();
}

// Whether the best match lies where the point truly is.
function isRight(view) {
  const { best, place } = view.found;
  return Math.hypot(best[0] - place[0], best[1] - place[1]) <= NEAR * view.camera.width;
}

// Say what is looked for, and in how many views it is found.
function tell(at, shown) {
  if (performance.now() - complainedAt < COMPLAINT_MS) return;
  const known = shown.filter((view) => view.found && view.found.place && !same(view.frame, at.frame));
  const right = known.filter(isRight).length;
  const where = `${at.frame[0]}, ${at.frame[1]} ${at.frame[2]}: ${at.u.toFixed(1)}, ${at.v.toFixed(1)}`;
  show(known.length ? `${where} · found again in ${right} of the ${known.length} views where its place is known` : where);
}

// How alike a distance is, from 0 to 1: it falls as fast as Sharpness says, in units of most pixels' distance.
function likelihood(z) {
  return Math.exp((-heat.sharpness * z) / heat.middle);
}

// The colour of each of the 256 codes of a distance, as red, green, blue and opacity in memory.
function colourTable() {
  const table = new Uint32Array(256);
  const bytes = new Uint8Array(table.buffer);
  for (let code = 0; code < 256; code++) {
    const position = likelihood(heat.scale * (code / 255) ** 2) * (COLOURS.length - 1);
    const i = Math.min(Math.floor(position), COLOURS.length - 2);
    const mix = COLOURS[i].map((value, c) => value + (position - i) * (COLOURS[i + 1][c] - value));
    bytes.set([mix[0], mix[1], mix[2], 255 * mix[3]], 4 * code);
  }
  return table;
}

// A view's heat map as a picture.
function layerOf(view, table) {
  const { width, height, codes, isDrawn } = view.found;
  if (!isDrawn) {
    Object.assign(view.layer, { width, height });
    const context = view.layer.getContext("2d", IN_MEMORY);
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    for (let i = 0; i < codes.length; i++) pixels[i] = table[codes[i]];
    context.putImageData(image, 0, 0);
    view.found.isDrawn = true;
  }
  return view.layer;
}

// Ask where all keypoints are matched, in all views that are shown.
let matches = { names: [], frames: new Map() };
let isMatching = false;
let isUnmatched = false;
async function askMatches() {
  if (isMatching) { isUnmatched = true; return; }
  isMatching = true;
  try {
    const frames = shownViews().map((view) => view.frame);
    if (!state.marks.length || !$("show-matches").checked) matches = { names: [], frames: new Map() };
    else {
      const found = await call("matches", { frames });
      matches = { names: found.names, frames: new Map(frames.map((frame, i) => [key(frame), found.frames[i]])) };
    }
    draw();
  } catch (error) { complain(error); }
  isMatching = false;
  if (isUnmatched) { isUnmatched = false; askMatches(); }
}
