// The list of keypoints.

// Select a keypoint, or none with "".
function choose(name) {
  if (chosen === name) return;
  chosen = name;
  renderList();
  askHeat();
  draw();
}

// Update the list and the buttons.
function renderList() {
  $("count").textContent = state.marks.length;
  $("empty").hidden = state.marks.length > 0;
  $("undo").disabled = !state.can_undo;
  $("redo").disabled = !state.can_redo;
  showButtons();
  document.title = `${state.marks.length && !state.is_saved ? "● " : ""}Keypoints ${$("title").textContent}`;
  if (document.activeElement && document.activeElement.classList.contains("name-field")) return;
  const focused = document.activeElement && document.activeElement.dataset && document.activeElement.dataset.name;
  $("list").replaceChildren(...state.marks.map(row));
  if (focused) (rowOf(focused) || { focus() {} }).focus();
  if (chosen && rowOf(chosen)) rowOf(chosen).scrollIntoView({ block: "nearest" });
}

// The row of a keypoint, by name.
const rowOf = (name) => [...$("list").children].find((line) => line.dataset.name === name);

// A new row for a keypoint.
function row(mark) {
  const line = document.createElement("li");
  const [dot, text, where] = ["dot", "name", "where"].map((className) => {
    return Object.assign(document.createElement("span"), { className });
  });
  const remove = document.createElement("button");
  line.dataset.name = mark.name;
  line.tabIndex = 0;
  line.classList.toggle("chosen", mark.name === chosen);
  dot.style.background = colourOf(mark.name);
  text.textContent = mark.name;
  where.textContent = `${mark.recording} · ${mark.camera} ${mark.frame}`;
  text.append(where);
  remove.textContent = "✕";
  remove.title = "Delete";
  remove.setAttribute("aria-label", `Delete ${mark.name}`);
  remove.onclick = (event) => { event.stopPropagation(); edit({ do: "delete", name: mark.name }); };
  line.append(dot, text, remove);
  line.onclick = () => { choose(mark.name); goTo(mark); };
  line.ondblclick = () => rename(mark.name);
  line.onkeydown = (event) => {
    if (event.target !== line) return;
    if (event.key === "Enter") { choose(mark.name); goTo(mark); }
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      const next = event.key === "ArrowDown" ? line.nextElementSibling : line.previousElementSibling;
      if (next) { choose(next.dataset.name); rowOf(next.dataset.name).focus(); }
      event.preventDefault();
    }
  };
  return line;
}

// Show a keypoint's frame in the main view, unless a view shows it already.
function goTo(mark) {
  if (!shownViews().some((view) => same(view.frame, frameOf(mark)))) views[0].show(frameOf(mark));
}

// Replace a keypoint's name in the list by a field to edit it.
function rename(name) {
  const line = rowOf(name);
  if (!line) return;
  const field = document.createElement("input");
  Object.assign(field, { className: "name-field", value: name, maxLength: 40 });
  field.setAttribute("aria-label", "Name");
  line.querySelector(".name").replaceChildren(field);
  field.select();
  let isOver = false;
  const end = (isWanted) => {
    if (isOver) return;
    isOver = true;
    const entered = field.value.trim();
    field.remove();
    renderList();
    (rowOf(name) || views[0].canvas).focus();
    if (isWanted && entered && entered !== name) edit({ do: "rename", name, new_name: entered });
  };
  field.onclick = field.ondblclick = (event) => event.stopPropagation();
  field.onblur = () => end(true);
  field.onkeydown = (event) => {
    event.stopPropagation();
    if (event.key === "Enter") end(true);
    if (event.key === "Escape") end(false);
  };
}
