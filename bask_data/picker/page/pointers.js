// Mouse, pen and touch on a view: pick, drag a keypoint, zoom, pan.

const REACH = 11; // radius in CSS pixels at which a keypoint can be grasped; its dot has a radius of 8
const STILL = 3; // CSS pixels that a press may move and still be a click
const WHEEL_ZOOM = 0.0015; // change of log(zoom) per pixel of the wheel: a notch of 100 pixels enlarges by 16 %
const PAD_ZOOM = 0.01; // the same for a pinch on a touch pad, which browsers send as a wheel with Ctrl
const LINE_PX = 33; // pixels per line of the wheel, for browsers that count in lines

let isSpaceHeld = false;

class Pointers {
  constructor(view) {
    this.view = view;
    this.fingers = new Map(); // fingers on the screen: {x, y} by pointer id
    this.panned = null; // {x, y}: last position of the pointer that pans
    this.isPinching = false; // true until the last finger has left, so that none of them picks
    const { canvas } = view;
    canvas.onpointerdown = (event) => this.press(event);
    canvas.onpointermove = (event) => this.move(event);
    canvas.onpointerup = (event) => this.release(event);
    canvas.onpointercancel = (event) => this.cancel(event);
    canvas.onpointerleave = () => { if (!dragged && !this.panned) hover(null); };
    canvas.onmousedown = (event) => { if (event.button === 1) event.preventDefault(); }; // no scrolling by the button
    canvas.addEventListener("wheel", (event) => this.turnWheel(event), { passive: false });
  }

  // Name of the keypoint within reach of a position on the canvas, or "".
  markAt({ x, y }) {
    let best = "";
    let least = REACH;
    for (const mark of state.marks) {
      if (!same(frameOf(mark), this.view.frame)) continue;
      const [markX, markY] = this.view.viewport.toCanvas(mark.u, mark.v);
      const away = Math.hypot(x - markX, y - markY);
      if (away < least) [best, least] = [mark.name, away];
    }
    return best;
  }

  press(event) {
    const at = this.view.locate(event);
    if (event.pointerType === "touch") this.fingers.set(event.pointerId, at);
    if (this.fingers.size > 1) return this.beginPinch();
    if (event.button > 1) return null;
    this.view.canvas.setPointerCapture(event.pointerId);
    if (event.button === 1 || isSpaceHeld) {
      this.panned = at;
      return this.showCursor(at);
    }
    const name = this.markAt(at);
    if (name) choose(name);
    dragged = { ...at, name, view: this.view, hasMoved: false };
    return hover(at.inside ? { view: this.view, u: at.u, v: at.v } : null);
  }

  move(event) {
    const at = this.view.locate(event);
    if (this.fingers.has(event.pointerId) && this.isPinching) return this.pinch(event.pointerId, at);
    if (this.panned) return this.pan(at);
    if (dragged && dragged.view === this.view) {
      dragged.hasMoved ||= Math.hypot(at.x - dragged.x, at.y - dragged.y) > STILL;
      // A finger that holds no keypoint pans an enlarged picture.
      if (event.pointerType === "touch" && !dragged.name && dragged.hasMoved && this.view.viewport.zoom > 1) {
        dragged = null;
        this.panned = at;
        return hover(null);
      }
      if (dragged.name && dragged.hasMoved) Object.assign(dragged, { u: at.u, v: at.v });
    }
    this.showCursor(at);
    return hover(at.inside || dragged ? { view: this.view, u: at.u, v: at.v } : null);
  }

  pan(at) {
    this.view.viewport.pan(at.x - this.panned.x, at.y - this.panned.y);
    this.panned = at;
    draw([this.view]);
  }

  // A second finger turns the first one's press into a pinch.
  beginPinch() {
    dragged = this.panned = null;
    this.isPinching = true;
    hover(null);
  }

  // Zoom and pan so that the point between the fingers stays between them.
  pinch(id, at) {
    const before = this.spread();
    this.fingers.set(id, at);
    const after = this.spread();
    if (!before || !after) return;
    this.view.zoomAbout(before.x, before.y, after.distance / before.distance, [after.x, after.y]);
  }

  // Midpoint and distance of two fingers, CSS pixels.
  spread() {
    const [a, b] = this.fingers.values();
    return b && { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, distance: Math.hypot(a.x - b.x, a.y - b.y) || 1 };
  }

  release(event) {
    const wasGesture = this.isPinching || this.panned;
    this.end(event);
    const done = dragged;
    dragged = null;
    if (wasGesture || !done || done.view !== this.view) return;
    const at = { frame: this.view.frame, u: done.u, v: done.v };
    if (done.name && done.hasMoved) {
      Object.assign(markOf(done.name) || {}, { u: done.u, v: done.v }); // until the server has answered
      edit({ do: "move", name: done.name, at });
    } else if (!done.name && done.inside && !done.hasMoved) edit({ do: "add", at });
  }

  cancel(event) {
    this.end(event);
    dragged = null;
    draw([this.view]);
  }

  end(event) {
    this.fingers.delete(event.pointerId);
    this.panned = null;
    if (!this.fingers.size) this.isPinching = false;
    this.showCursor(this.view.locate(event));
  }

  turnWheel(event) {
    event.preventDefault();
    const at = this.view.locate(event);
    const pixels = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY : event.deltaY * LINE_PX;
    this.view.zoomAbout(at.x, at.y, Math.exp(-pixels * (event.ctrlKey ? PAD_ZOOM : WHEEL_ZOOM)));
    if (!dragged) this.move(event);
  }

  showCursor(at) {
    const { style } = this.view.canvas;
    if (this.panned) style.cursor = "grabbing";
    else style.cursor = isSpaceHeld || this.markAt(at) ? "grab" : "crosshair";
  }
}

// While Space is held, dragging pans, unless a button or field has the focus.
function holdSpace(event) {
  if (event.target.closest("button, input, select, dialog")) return;
  event.preventDefault();
  isSpaceHeld = true;
}

function letSpaceGo() {
  isSpaceHeld = false;
}
