// Heat maps of the point under the pointer, and matches of all keypoints.

const NEAR = 0.04; // share of the image's width: a best match this close to ground truth is an inlier. It is the radius
// of a ring on a view 200 pixels wide; for partly trained networks the inlier ratio is about proportional to it.
const COLOURS = [[10, 12, 18, 0.46], [87, 16, 110, 0.55], [188, 55, 84, 0.72], [249, 142, 9, 0.85], [252, 255, 164, 0.95]];
const heat = { at: null, scale: 1, middle: 1, sharpness: 6 };

// The pixel to search for: under the pointer, or else of the selected keypoint.
function wanted() {
  if (hovered) return { frame: hovered.view.frame, u: hovered.u, v: hovered.v };
  const mark = markOf(chosen);
  return mark ? { frame: frameOf(mark), u: mark.u, v: mark.v } : null;
}

// Set the hovered pixel, {view, u, v} or null.
function hover(at) {
  const touched = [hovered, at].filter((place) => place).map((place) => place.view);
  hovered = at;
  askHeat();
  draw(touched);
}

// Request the heat maps of the wanted pixel for all visible views.
let isAsking = false;
let isStale = false;
async function askHeat() {
  const at = wanted();
  if (!at) {
    heat.at = null;
    views.forEach((view) => { view.found = null; });
    show(state.marks.length ? "" : "Move over a picture to see its matches in the other pictures.");
    return draw();
  }
  // One request at a time: the pointer moves faster than answers arrive, and only its last position matters.
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

// Read the server's heat maps: the length of a JSON header, the header, and one byte per pixel of each map.
function takeHeat(buffer, at, shown, frames) {
  if (!wanted()) return;
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  Object.assign(heat, { at, scale: header.scale, middle: header.middle });
  shown.forEach((view, i) => {
    const map = header.maps[i];
    if (!map) { if (view.frame === frames[i]) view.found = null; return; }
    const [height, width] = map.size;
    const codes = new Uint8Array(buffer, offset, width * height);
    offset += width * height;
    if (view.frame === frames[i]) view.found = { ...map, width, height, codes, isDrawn: false };
  });
  summarise(at, shown);
  draw();
}

// Whether a view's best match is close to ground truth.
function isInlier(view) {
  const { best, place } = view.found;
  return Math.hypot(best[0] - place[0], best[1] - place[1]) <= NEAR * view.camera.width;
}

// Show the searched pixel, and how many views match it correctly.
function summarise(at, shown) {
  if (performance.now() - complainedAt < COMPLAINT_MS) return;
  const known = shown.filter((view) => view.found && view.found.place && !same(view.frame, at.frame));
  const nInliers = known.filter(isInlier).length;
  const where = `${at.frame[0]}, ${at.frame[1]} ${at.frame[2]}: ${at.u.toFixed(1)}, ${at.v.toFixed(1)}`;
  show(known.length ? `${where} · matched correctly in ${nInliers} of ${known.length} views with ground truth` : where);
}

// Similarity from 0 to 1 of a distance, relative to the median distance; it decays at the rate of Sharpness.
function likelihood(z) {
  return Math.exp((-heat.sharpness * z) / heat.middle);
}

// The RGBA colours of the 256 distance codes.
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

// A view's heat map as a canvas.
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

// Request the best matches of all keypoints in all visible views.
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
      const answer = await call("matches", { frames });
      matches = { names: answer.names, frames: new Map(frames.map((frame, i) => [key(frame), answer.frames[i]])) };
    }
    draw();
  } catch (error) { complain(error); }
  isMatching = false;
  if (isUnmatched) { isUnmatched = false; askMatches(); }
}
