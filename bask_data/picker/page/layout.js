// Layout of the views: the main picture as large as possible, and as many other views as fit beside or below it.

const GAP = 10; // between views, CSS pixels
const LEAST_SIDE = 132; // least width of another view's picture, CSS pixels: matches are visible, its fields just fit
const MAIN_FRAME = 60; // height of the main view without its picture, CSS pixels, measured
const SIDE_FRAME = 62; // the same for the other views
const WORTH = 0.1; // value of one more view, as a share of the main picture's area

// Arrange the views for the window's size and the main picture's aspect ratio.
function arrange() {
  if (views.length <= N_OTHERS || !views[0].frame) return;
  const area = $("views");
  const { width, height } = views[0].camera;
  const best = bestArrangement(area.clientWidth, area.clientHeight, width / height);
  area.style.gridTemplateColumns = best.isBeside ? `${best.main}px minmax(0, 1fr)` : "minmax(0, 1fr)";
  const picture = best.isBeside ? best.main / (width / height) : best.main - MAIN_FRAME;
  $("main-view").style.maxHeight = `${Math.ceil(picture + MAIN_FRAME)}px`;
  $("main-view").style.maxWidth = `${Math.ceil((picture * width) / height)}px`;
  area.style.gridTemplateRows = best.isBeside ? "minmax(0, 1fr)" : `${best.main}px minmax(0, 1fr)`;
  $("other-views").style.gridTemplateColumns = `repeat(${best.columns}, minmax(0, 1fr))`;
  $("other-views").style.gridTemplateRows = `repeat(${best.rows}, minmax(0, ${best.sideHeight}px))`;
  views.forEach((view, i) => view.setShown(i <= best.columns * best.rows));
  draw();
}

// The arrangement of at most N_OTHERS views with the highest value.
function bestArrangement(width, height, aspect) {
  let best = { isBeside: true, columns: 1, rows: 1, main: 0.7 * width, sideHeight: height, value: 0 };
  for (let columns = 1; columns <= N_OTHERS; columns++) {
    for (let rows = 1; columns * rows <= N_OTHERS; rows++) {
      const candidates = [beside, below].map((arrangement) => arrangement(width, height, aspect, columns, rows));
      for (const candidate of candidates) {
        if (candidate.value > best.value) best = { ...candidate, columns, rows };
      }
    }
  }
  return best;
}

// The other views in columns to the right, in the width that the main picture leaves.
function beside(width, height, aspect, columns, rows) {
  const least = columns * LEAST_SIDE + columns * GAP;
  const main = Math.min(width - least, (height - MAIN_FRAME) * aspect);
  const sideWidth = (width - main) / columns - GAP;
  const sideHeight = Math.min((height - (rows - 1) * GAP) / rows, sideWidth / aspect + SIDE_FRAME);
  const value = valueOf(main, main / aspect, aspect, sideHeight, columns * rows);
  return { isBeside: true, main: Math.floor(main), sideHeight: Math.floor(sideHeight), value };
}

// The other views in rows below, for windows that are taller than wide.
function below(width, height, aspect, columns, rows) {
  const sideWidth = (width - (columns - 1) * GAP) / columns;
  const least = rows * (LEAST_SIDE / aspect + SIDE_FRAME + GAP);
  const main = Math.min(height - least, width / aspect + MAIN_FRAME);
  const sideHeight = Math.min((height - main) / rows - GAP, sideWidth / aspect + SIDE_FRAME);
  const picture = main - MAIN_FRAME;
  const value = sideWidth < LEAST_SIDE ? 0 : valueOf(picture * aspect, picture, aspect, sideHeight, columns * rows);
  return { isBeside: false, main: Math.floor(main), sideHeight: Math.floor(sideHeight), value };
}

// Value of an arrangement: the pictures' areas and the number of views; 0 if a picture would be too small.
function valueOf(mainWidth, mainHeight, aspect, sideHeight, n) {
  const sidePicture = sideHeight - SIDE_FRAME;
  const isPossible = mainWidth > 0 && mainHeight > 0 && sidePicture * aspect >= LEAST_SIDE - 1;
  return isPossible ? mainWidth * mainHeight * (1 + WORTH * n) + n * sidePicture * sidePicture * aspect : 0;
}
