// Where the views lie: the main one as large as its picture can be, and as many others as have room beside or below.

const GAP = 10;
const LEAST_SIDE = 132; // CSS pixels, width of another view's picture at least: matches can be told, its fields just fit
const MAIN_FRAME = 60; // CSS pixels of a main view's height that are not its picture; measured
const SIDE_FRAME = 62; // the same of the other views
const WORTH = 0.1; // of the main picture's area: what one more of the other views is worth

// Arrange the views as the window and the main picture's shape ask for.
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

// Of all ways to place at most N_OTHERS views, that of the largest main picture and the most others.
function bestArrangement(width, height, aspect) {
  let best = { isBeside: true, columns: 1, rows: 1, main: 0.7 * width, sideHeight: height, value: 0 };
  for (let columns = 1; columns <= N_OTHERS; columns++) {
    for (let rows = 1; columns * rows <= N_OTHERS; rows++) {
      for (const tried of [beside(width, height, aspect, columns, rows), below(width, height, aspect, columns, rows)]) {
        if (tried.value > best.value) best = { ...tried, columns, rows };
      }
    }
  }
  return best;
}

// The others in columns at the right: all that the main picture leaves of the width is theirs.
function beside(width, height, aspect, columns, rows) {
  const least = columns * LEAST_SIDE + columns * GAP;
  const main = Math.min(width - least, (height - MAIN_FRAME) * aspect);
  const sideWidth = (width - main) / columns - GAP;
  const sideHeight = Math.min((height - (rows - 1) * GAP) / rows, sideWidth / aspect + SIDE_FRAME);
  const value = valueOf(main, main / aspect, aspect, sideHeight, columns * rows);
  return { isBeside: true, main: Math.floor(main), sideHeight: Math.floor(sideHeight), value };
}

// The others in rows below, on windows that are taller than wide.
function below(width, height, aspect, columns, rows) {
  const sideWidth = (width - (columns - 1) * GAP) / columns;
  const least = rows * (LEAST_SIDE / aspect + SIDE_FRAME + GAP);
  const main = Math.min(height - least, width / aspect + MAIN_FRAME);
  const sideHeight = Math.min((height - main) / rows - GAP, sideWidth / aspect + SIDE_FRAME);
  const picture = main - MAIN_FRAME;
  const value = sideWidth < LEAST_SIDE ? 0 : valueOf(picture * aspect, picture, aspect, sideHeight, columns * rows);
  return { isBeside: false, main: Math.floor(main), sideHeight: Math.floor(sideHeight), value };
}

// What an arrangement is worth: the pictures' areas, and the number of others; 0 where one would be too small.
function valueOf(mainWidth, mainHeight, aspect, sideHeight, n) {
  const sidePicture = sideHeight - SIDE_FRAME;
  const isPossible = mainWidth > 0 && mainHeight > 0 && sidePicture * aspect >= LEAST_SIDE - 1;
  return isPossible ? mainWidth * mainHeight * (1 + WORTH * n) + n * sidePicture * sidePicture * aspect : 0;
}
