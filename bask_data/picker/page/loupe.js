// The loupe: magnified pixels around the pointer, with a cross at the exact position that a click picks.

const LOUPE = 150; // side of the loupe, CSS pixels
const LOUPE_AWAY = 26; // distance from the pointer, CSS pixels, so that its surroundings stay visible
const MAGNIFIED = [8, 4, 24]; // CSS pixels per image pixel: minimum, factor on the view's scale, maximum
const NO_LOUPE = 12; // CSS pixels per image pixel of a view that needs no loupe

// Show the loupe beside the pointer, or hide it where the view is enlarged enough.
function paintLoupe() {
  const canvas = $("loupe");
  const isWanted = hovered && $("show-loupe").checked && hovered.view.picture && hovered.view.viewport.scale < NO_LOUPE;
  canvas.hidden = !isWanted;
  if (!isWanted) return;
  placeLoupe(canvas);
  const ratio = devicePixelRatio || 1;
  if (canvas.width !== Math.round(LOUPE * ratio)) canvas.width = canvas.height = Math.round(LOUPE * ratio);
  const context = canvas.getContext("2d", IN_MEMORY);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  paintMagnified(context);
  paintReading(context);
}

// Place the loupe above and right of the pointer, or on the opposite side at the window's edges.
function placeLoupe(canvas) {
  const { view, u, v } = hovered;
  const box = view.canvas.getBoundingClientRect();
  const [x, y] = view.viewport.toCanvas(u, v).map((at, i) => at + (i ? box.top : box.left));
  const isRight = x + LOUPE_AWAY + LOUPE < innerWidth - 4;
  const isAbove = y - LOUPE_AWAY - LOUPE > 4;
  canvas.style.left = `${isRight ? x + LOUPE_AWAY : x - LOUPE_AWAY - LOUPE}px`;
  canvas.style.top = `${isAbove ? y - LOUPE_AWAY - LOUPE : y + LOUPE_AWAY}px`;
}

// Draw image pixels as squares, keypoints of the frame as rings, a box around the picked pixel, and the cross.
function paintMagnified(context) {
  const { view, u, v } = hovered;
  const [least, times, most] = MAGNIFIED;
  const scale = between(times * view.viewport.scale, least, most);
  const toLoupe = (at, middle) => LOUPE / 2 + scale * (at - middle);
  context.fillStyle = "#07080b";
  context.fillRect(0, 0, LOUPE, LOUPE);
  context.imageSmoothingEnabled = false;
  const { width, height } = view.camera;
  context.drawImage(view.picture, toLoupe(-0.5, u), toLoupe(-0.5, v), scale * width, scale * height);
  for (const mark of state.marks) {
    if (!same(frameOf(mark), view.frame) || (dragged && dragged.name === mark.name)) continue;
    ring(context, [toLoupe(mark.u, u), toLoupe(mark.v, v)], 6, colourOf(mark.name), 2);
  }
  const [left, top] = [toLoupe(Math.round(u) - 0.5, u), toLoupe(Math.round(v) - 0.5, v)];
  for (const [colour, wide] of [["#000c", 3], ["#fff", 1]]) {
    Object.assign(context, { strokeStyle: colour, lineWidth: wide });
    context.strokeRect(left, top, scale, scale);
  }
  cross(context, [LOUPE / 2, LOUPE / 2], "#fff", LOUPE / 2, false, scale / 2 + 4);
}

// Draw the pixel's coordinates.
function paintReading(context) {
  context.font = "600 11.5px system-ui, sans-serif";
  const text = `${hovered.u.toFixed(1)}, ${hovered.v.toFixed(1)}`;
  const wide = context.measureText(text).width;
  context.fillStyle = "#0d0f14e6";
  context.beginPath();
  context.roundRect(6, LOUPE - 25, wide + 12, 19, 5);
  context.fill();
  context.fillStyle = "#fff";
  context.fillText(text, 12, LOUPE - 11.5);
}
