// A view: a picture with its heat map and keypoints, and the fields that select its frame.

const KEY_ZOOM = 1.5; // factor of a press of + or -

class View {
  constructor(parent) {
    const root = $("view").content.cloneNode(true).firstElementChild;
    parent.append(root);
    Object.assign(this, { root, frame: null, picture: null, found: null, layer: blank(), backdrop: blank(), drawn: "" });
    for (const name of ["recording", "camera", "swap", "frame", "zoom"]) this[`${name}Field`] = root.querySelector(`.${name}`);
    this.canvas = root.querySelector("canvas");
    this.output = root.querySelector("output");
    this.viewport = new Viewport();
    this.pointers = new Pointers(this);
    this.isShown = true;
    this.isLoaded = false;
    this.recordingField.append(...groups());
    this.recordingField.onchange = () => this.show(opening(this.recordingField.value, 0.5));
    this.cameraField.onchange = () => this.show([this.frame[0], this.cameraField.value, this.frame[2]]);
    this.frameField.oninput = () => this.show([this.frame[0], this.frame[1], Number(this.frameField.value)]);
    this.swapField.onclick = () => this.swap();
    this.zoomField.onclick = () => this.resetZoom();
    this.canvas.onkeydown = (event) => this.key(event);
    this.canvas.onblur = () => { if (hovered && hovered.view === this) hover(null); };
    new ResizeObserver(() => draw([this])).observe(this.canvas);
  }

  get camera() {
    return cameraOf(this.frame);
  }

  get isMain() {
    return views[0] === this;
  }

  // Show a frame: its fields at once, its picture and heat map when they arrive.
  show(frame) {
    const camera = cameraOf(frame);
    const before = this.frame;
    this.frame = [frame[0], camera.name, between(frame[2], 0, camera.n_frames - 1)];
    if (!before || before[0] !== frame[0] || before[1] !== camera.name) this.viewport.reset();
    Object.assign(this, { found: null, isLoaded: false });
    this.root.classList.remove("ready");
    this.fillFields(camera);
    remember();
    if (this.isMain) arrange();
    if (this.isShown) return this.load();
    return null;
  }

  fillFields(camera) {
    const [recording, , number] = this.frame;
    this.recordingField.value = recording;
    this.cameraField.replaceChildren(...camerasOf(this.frame).map((known) => new Option(known.name)));
    this.cameraField.value = camera.name;
    this.cameraField.hidden = camerasOf(this.frame).length < 2;
    this.frameField.max = camera.n_frames - 1;
    this.frameField.value = number;
    const last = Object.assign(document.createElement("span"), { textContent: `/${camera.n_frames - 1}` });
    this.output.replaceChildren(`${number}`, last);
    this.canvas.setAttribute("aria-label", `${recording}, ${camera.name}, frame ${number}`);
  }

  // Fetch the picture and request descriptors; hidden views request nothing.
  async load() {
    const { frame } = this;
    this.isLoaded = true;
    try {
      const picture = await pictureOf(frame);
      if (this.frame !== frame) return;
      Object.assign(this, { picture, drawn: "" });
      draw([this]);
      await described(frame, () => this.frame === frame && this.isShown);
      if (this.frame !== frame) return;
      if (!this.isShown) { this.isLoaded = false; return; }
      this.root.classList.add("ready");
      askHeat();
      askMatches();
    } catch (error) { complain(error); }
  }

  // Show or hide the view.
  setShown(isShown) {
    this.isShown = isShown;
    this.root.hidden = !isShown;
    if (isShown && this.frame && !this.isLoaded) this.load();
  }

  swap() {
    const [main] = views;
    const mine = this.frame;
    this.show(main.frame);
    main.show(mine);
  }

  // Update the viewport's sizes. Fractions of CSS pixels matter: they are tenths of a pixel of a small image.
  measure() {
    const { width, height } = this.canvas.getBoundingClientRect();
    this.viewport.measure({ width, height }, this.camera);
  }

  // An event's position (x, y) on the canvas, its pixel (u, v), and whether it is inside the image.
  locate(event) {
    this.measure();
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const [u, v] = this.viewport.toPixel(x, y);
    const { width, height } = this.camera;
    const inside = u >= -0.5 && v >= -0.5 && u < width - 0.5 && v < height - 0.5;
    return { x, y, u: clamp(u, width), v: clamp(v, height), inside };
  }

  zoomAbout(x, y, factor, to = [x, y]) {
    this.measure();
    this.viewport.zoomAbout(x, y, factor, to);
    this.showZoom();
  }

  resetZoom() {
    this.viewport.reset();
    this.showZoom();
  }

  // Zoom about the cross, or about the centre without one.
  zoomByKey(factor) {
    this.measure();
    const isHere = hovered && hovered.view === this;
    const { width, height } = this.viewport.canvas;
    this.zoomAbout(...(isHere ? this.viewport.toCanvas(hovered.u, hovered.v) : [width / 2, height / 2]), factor);
  }

  showZoom() {
    const { zoom } = this.viewport;
    this.zoomField.hidden = zoom < 1.01;
    this.zoomField.textContent = `${zoom < 10 ? zoom.toFixed(1) : Math.round(zoom)}×`;
    draw([this]);
  }

  key(event) {
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const turns = { ",": -1, ".": 1, PageUp: -10, PageDown: 10 };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (moves[event.key]) this.nudge(...moves[event.key], event.shiftKey ? 10 : 1);
    else if (turns[event.key]) this.show([this.frame[0], this.frame[1], this.frame[2] + turns[event.key]]);
    else if (event.key === "Enter") {
      if (hovered && hovered.view === this) edit({ do: "add", at: { frame: this.frame, u: hovered.u, v: hovered.v } });
    } else return;
    event.preventDefault();
  }

  // Move the selected keypoint by pixels, or the cross by visible steps; an enlarged picture follows.
  nudge(du, dv, by) {
    this.measure();
    const { width, height } = this.camera;
    const mark = markOf(chosen);
    if (mark && same(frameOf(mark), this.frame)) {
      Object.assign(mark, { u: clamp(mark.u + by * du, width), v: clamp(mark.v + by * dv, height) });
      settle(mark);
      this.viewport.reveal(mark.u, mark.v);
      hover({ view: this, u: mark.u, v: mark.v });
      return;
    }
    const from = hovered && hovered.view === this ? hovered : { u: (width - 1) / 2, v: (height - 1) / 2 };
    const step = by * Math.max(1, Math.round(2 / this.viewport.scale));
    const [u, v] = [clamp(from.u + step * du, width), clamp(from.v + step * dv, height)];
    this.viewport.reveal(u, v);
    hover({ view: this, u, v });
  }
}
