// How a picture lies on its canvas: all of it, or enlarged about a point.

const MOST_SCALE = 40; // CSS pixels an image's pixel: more would not let it be hit more exactly

class Viewport {
  constructor() {
    this.canvas = { width: 1, height: 1 };
    this.image = { width: 1, height: 1 };
    this.reset();
  }

  // Show all of the picture.
  reset() {
    this.zoom = 1;
    this.centre = [0.5, 0.5]; // what is in the canvas's middle, as shares of the image's sides
  }

  // The sizes of the canvas in CSS pixels, and of the image in its own.
  measure(canvas, image) {
    this.canvas = canvas;
    this.image = image;
    this.zoom = Math.min(this.zoom, this.mostZoom);
  }

  // CSS pixels an image's pixel when all of it is shown.
  get fit() {
    return Math.min(this.canvas.width / this.image.width, this.canvas.height / this.image.height) || 1;
  }

  get mostZoom() {
    return Math.max(1, MOST_SCALE / this.fit);
  }

  get scale() {
    return this.fit * this.zoom;
  }

  // The image's left or upper edge on the canvas: in the middle where it is smaller, without a gap where it is larger.
  edge(share, canvas, image) {
    const size = this.scale * image;
    return size <= canvas ? (canvas - size) / 2 : between(canvas / 2 - share * size, canvas - size, 0);
  }

  get x() {
    return this.edge(this.centre[0], this.canvas.width, this.image.width);
  }

  get y() {
    return this.edge(this.centre[1], this.canvas.height, this.image.height);
  }

  // Pixel centres are integers, so an image begins half a pixel before 0.
  toCanvas(u, v) {
    return [this.x + this.scale * (u + 0.5), this.y + this.scale * (v + 0.5)];
  }

  toPixel(x, y) {
    return [(x - this.x) / this.scale - 0.5, (y - this.y) / this.scale - 0.5];
  }

  // Move the image so that its edges come to lie there, as far as it leaves no gap.
  moveTo(x, y) {
    const { canvas, image, scale } = this;
    this.centre = [(canvas.width / 2 - x) / (scale * image.width), (canvas.height / 2 - y) / (scale * image.height)];
    this.centre = [
      (canvas.width / 2 - this.x) / (scale * image.width),
      (canvas.height / 2 - this.y) / (scale * image.height),
    ];
  }

  pan(dx, dy) {
    this.moveTo(this.x + dx, this.y + dy);
  }

  // Enlarge, or with a factor below 1 reduce, so that what lies at a place of the canvas stays there, or goes elsewhere.
  zoomAbout(x, y, factor, [toX, toY] = [x, y]) {
    const [u, v] = this.toPixel(x, y);
    this.zoom = between(this.zoom * factor, 1, this.mostZoom);
    this.moveTo(toX - this.scale * (u + 0.5), toY - this.scale * (v + 0.5));
  }

  // Pan until a pixel is at least `margin` away from the canvas's edges.
  reveal(u, v, margin = 24) {
    const [x, y] = this.toCanvas(u, v);
    const { width, height } = this.canvas;
    this.pan(between(x, margin, width - margin) - x, between(y, margin, height - margin) - y);
  }
}
