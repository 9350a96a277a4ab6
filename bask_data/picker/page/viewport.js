// Position and scale of a picture on its canvas.

const MOST_SCALE = 40; // CSS pixels per image pixel; a larger scale would not improve the precision of picks

class Viewport {
  constructor() {
    this.canvas = { width: 1, height: 1 };
    this.image = { width: 1, height: 1 };
    this.reset();
  }

  // Show the whole picture.
  reset() {
    this.zoom = 1;
    this.centre = [0.5, 0.5]; // point at the canvas's centre, as shares of the image's width and height
  }

  // Set the sizes of the canvas in CSS pixels and of the image in image pixels.
  measure(canvas, image) {
    this.canvas = canvas;
    this.image = image;
    this.zoom = Math.min(this.zoom, this.mostZoom);
  }

  // CSS pixels per image pixel at which the whole picture fits.
  get fit() {
    return Math.min(this.canvas.width / this.image.width, this.canvas.height / this.image.height) || 1;
  }

  get mostZoom() {
    return Math.max(1, MOST_SCALE / this.fit);
  }

  get scale() {
    return this.fit * this.zoom;
  }

  // The image's left or upper edge on the canvas: a smaller image is centred, a larger one leaves no gap.
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

  // Pixel centres are integers, so an image begins at -0.5.
  toCanvas(u, v) {
    return [this.x + this.scale * (u + 0.5), this.y + this.scale * (v + 0.5)];
  }

  toPixel(x, y) {
    return [(x - this.x) / this.scale - 0.5, (y - this.y) / this.scale - 0.5];
  }

  // Move the image's left and upper edges to (x, y), as far as this leaves no gap.
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

  // Scale by a factor, keeping the point at (x, y) of the canvas in place, or moving it to (toX, toY).
  zoomAbout(x, y, factor, [toX, toY] = [x, y]) {
    const [u, v] = this.toPixel(x, y);
    this.zoom = between(this.zoom * factor, 1, this.mostZoom);
    this.moveTo(toX - this.scale * (u + 0.5), toY - this.scale * (v + 0.5));
  }

  // Pan until a pixel is at least `margin` CSS pixels away from the canvas's edges.
  reveal(u, v, margin = 24) {
    const [x, y] = this.toCanvas(u, v);
    const { width, height } = this.canvas;
    this.pan(between(x, margin, width - margin) - x, between(y, margin, height - margin) - y);
  }
}
