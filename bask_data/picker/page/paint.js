// Drawing the views.

const IN_MEMORY = { willReadFrequently: true }; // as fast with a GPU, and twice as fast without one
const SHARP = 5; // CSS pixels per image pixel from which pixels are drawn as squares

// Draw views and the loupe at the browser's next frame.
const due = new Set();
function draw(some = views) {
  if (!due.size) requestAnimationFrame(() => {
    const table = colourTable();
    for (const view of due) if (views.includes(view) && view.isShown) paint(view, table);
    due.clear();
    if (views.length) paintLoupe();
  });
  for (const view of some) due.add(view);
}

// Colour of a keypoint; neighbours in the list have distant hues.
function colourOf(name) {
  const i = state.marks.findIndex((mark) => mark.name === name);
  return `hsl(${(((0.09 + i * 0.618034) % 1) * 360).toFixed(1)} 95% ${(i >> 3) % 2 ? 74 : 62}%)`;
}

// Draw a view: picture, heat map, matches, keypoints.
function paint(view, table) {
  const { canvas, picture } = view;
  const ratio = devicePixelRatio || 1;
  const box = canvas.getBoundingClientRect();
  const [width, height] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d", IN_MEMORY);
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, width, height);
  if (!view.frame || !picture || !width || !height) return;
  view.measure();
  context.drawImage(backdropOf(view, width, height, ratio), 0, 0);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  if (view.found && $("show-heat").checked) drawOver(context, view, layerOf(view, table));
  paintMatches(context, view);
  paintFound(context, view);
  paintMarks(context, view);
}

// Draw a picture over the image, edge to edge.
function drawOver(context, view, picture) {
  const { x, y, scale } = view.viewport;
  context.drawImage(picture, x, y, scale * view.camera.width, scale * view.camera.height);
}

// The scaled picture, cached: smooth scaling is slow, and views are redrawn with every move of the pointer.
function backdropOf(view, width, height, ratio) {
  const { backdrop, picture, frame } = view;
  const { x, y, scale } = view.viewport;
  const drawn = [...frame, width, height, x, y, scale].join("\n");
  if (view.drawn !== drawn) {
    Object.assign(backdrop, { width, height });
    const context = backdrop.getContext("2d", IN_MEMORY);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.imageSmoothingQuality = "high";
    context.imageSmoothingEnabled = scale < SHARP;
    drawOver(context, view, picture);
    view.drawn = drawn;
  }
  return backdrop;
}

// Draw a circle with a dark rim, visible on any background.
function ring(context, [x, y], radius, colour, width) {
  for (const [stroke, wide] of [["#000a", width + 2], [colour, width]]) {
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    Object.assign(context, { strokeStyle: stroke, lineWidth: wide });
    context.stroke();
  }
}

// Draw each keypoint's best match in other frames as a dot of its colour.
function paintMatches(context, view) {
  const best = matches.frames.get(key(view.frame));
  if (!best) return;
  matches.names.forEach((name, i) => {
    const mark = markOf(name);
    if (!mark || same(frameOf(mark), view.frame)) return;
    const [x, y] = view.viewport.toCanvas(best[i][0], best[i][1]);
    context.fillStyle = colourOf(name);
    context.strokeStyle = "#000b";
    context.lineWidth = 1.5;
    context.beginPath();
    context.arc(x, y, name === chosen ? 5 : 3.5, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
  });
}

// Draw the best match and ground truth of the searched pixel; in the pointer's own view, the cross.
function paintFound(context, view) {
  if (view.found && heat.at && !same(view.frame, heat.at.frame)) {
    const { best, place } = view.found;
    const colour = !place ? "#fff" : isInlier(view) ? "#5fd38d" : "#ff6b6b";
    // A best match at a large distance is faint: it most likely is no match.
    context.globalAlpha = 0.25 + 0.75 * Math.min(1, 2 * likelihood(view.found.z));
    ring(context, view.viewport.toCanvas(...best), 8, colour, 2);
    context.globalAlpha = 1;
    if (place && !isInlier(view)) cross(context, view.viewport.toCanvas(...place), "#5fd38d", 5, true);
  }
  if (hovered && hovered.view === view && !(dragged && dragged.name)) {
    cross(context, view.viewport.toCanvas(hovered.u, hovered.v), "#fff", 9, false);
  }
}

// Draw a cross: upright with an open centre, or slanted.
function cross(context, [x, y], colour, size, isSlanted, gap = isSlanted ? 0 : 3) {
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

// Draw the keypoints of a view's frame, the selected one on top.
function paintMarks(context, view) {
  const placed = state.marks.filter((mark) => same(frameOf(mark), view.frame)).map((mark) => {
    const isDragged = dragged && dragged.name === mark.name && dragged.hasMoved;
    return { name: mark.name, at: isDragged ? view.viewport.toCanvas(dragged.u, dragged.v) : view.viewport.toCanvas(mark.u, mark.v) };
  });
  placed.sort((a, b) => (a.name === chosen) - (b.name === chosen));
  for (const { name, at: [x, y] } of placed) {
    const isChosen = name === chosen;
    context.beginPath();
    context.arc(x, y, isChosen ? 7 : 5.5, 0, 2 * Math.PI);
    context.fillStyle = colourOf(name);
    context.fill();
    ring(context, [x, y], isChosen ? 8 : 6.5, "#fff", isChosen ? 2.5 : 1.5);
    if (isChosen || view.isMain) paintName(context, view, name, [x, y], placed);
  }
}

// Draw a name beside its keypoint, unless it would cover another keypoint; the selected one is always named.
function paintName(context, view, name, [x, y], placed) {
  const isChosen = name === chosen;
  context.font = `${isChosen ? 600 : 500} 12px system-ui, sans-serif`;
  const wide = context.measureText(name).width;
  const left = x + 14 + wide > view.canvas.clientWidth ? x - 18 - wide : x + 12;
  const hides = ({ at: [u, v] }) => u > left - 8 && u < left + wide + 18 && Math.abs(v - y) < 18;
  if (!isChosen && placed.some((mark) => mark.name !== name && hides(mark))) return;
  context.fillStyle = isChosen ? "#0d0f14e6" : "#0d0f1499";
  context.beginPath();
  context.roundRect(left, y - 10, wide + 10, 20, 6);
  context.fill();
  context.fillStyle = "#fff";
  context.fillText(name, left + 5, y + 4);
}
