// Keys, buttons, and start-up.

function flip(id) {
  $(id).checked = !$(id).checked;
  $(id).onchange();
}

// The view that keys apply to: under the pointer, or with the focus, or else the main one.
function keyView() {
  return (hovered && hovered.view) || views.find((view) => view.canvas === document.activeElement) || views[0];
}

const KEYS = {
  delete: () => { if (chosen) edit({ do: "delete", name: chosen }); },
  backspace: () => { if (chosen) edit({ do: "delete", name: chosen }); },
  escape: () => { choose(""); hover(null); },
  f2: () => { if (chosen) rename(chosen); },
  "?": () => $("keys").showModal(),
  h: () => flip("show-heat"),
  m: () => flip("show-matches"),
  l: () => flip("show-loupe"),
  f: () => shuffle(),
  "+": () => keyView().zoomByKey(KEY_ZOOM),
  "=": () => keyView().zoomByKey(KEY_ZOOM),
  "-": () => keyView().zoomByKey(1 / KEY_ZOOM),
  0: () => keyView().resetZoom(),
};
const CONTROL_KEYS = {
  z: (event) => edit({ do: event.shiftKey ? "redo" : "undo" }),
  y: () => edit({ do: "redo" }),
  s: () => save(),
};

function onKey(event) {
  const isTyping = event.target.matches("input:not([type=range]):not([type=checkbox]), select");
  if (isTyping || document.querySelector("dialog[open]")) return;
  if (event.key === " ") return holdSpace(event);
  const isControl = event.ctrlKey || event.metaKey;
  if (event.altKey && !isControl) return;
  const letter = event.key.toLowerCase();
  const act = isControl ? CONTROL_KEYS[letter] : KEYS[letter];
  if (!act) return;
  act(event);
  event.preventDefault();
}

function onKeyUp(event) {
  if (event.key === " ") letSpaceGo();
}

function setSharpness() {
  heat.sharpness = Number($("sharpness").value);
  for (const view of views) if (view.found) view.found.isDrawn = false;
  draw();
}

// Connect buttons, keys and resizing to their actions.
function bind() {
  const clicks = {
    undo: () => edit({ do: "undo" }),
    redo: () => edit({ do: "redo" }),
    shuffle,
    help: () => $("keys").showModal(),
    propose: openProposals,
    save,
    "job-cancel": cancelJob,
    "go-on": () => { $("saved").hidden = true; },
    finish,
  };
  for (const [id, act] of Object.entries(clicks)) $(id).onclick = () => act();
  $("show-heat").onchange = () => draw();
  $("show-loupe").onchange = () => draw();
  $("show-matches").onchange = () => askMatches();
  $("sharpness").oninput = setSharpness;
  $("propose-dialog").onclose = propose;
  document.addEventListener("keydown", onKey);
  document.addEventListener("keyup", onKeyUp);
  addEventListener("blur", letSpaceGo);
  new ResizeObserver(arrange).observe($("views"));
}

async function start() {
  const answer = await call("start");
  Object.assign(state, answer);
  heat.sharpness = Number($("sharpness").value); // browsers restore fields after a reload
  $("title").textContent = state.title;
  for (let i = 0; i <= N_OTHERS; i++) views.push(new View(i ? $("other-views") : $("main-view")));
  bind();
  const main = state.marks.length ? frameOf(state.marks[0]) : opening(state.recordings[0].name, 0.5);
  const frames = remembered() || [main, ...suggested(main, 0)];
  views.forEach((view, i) => { view.frame = frames[i]; });
  arrange();
  views.forEach((view) => view.show(view.frame));
  renderList();
  askHeat();
  if (answer.job) resume(answer.job).catch(complain);
}

start().catch(complain);
