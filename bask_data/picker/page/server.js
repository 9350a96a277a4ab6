// Speaking to the server, which keeps the draft: every step is sent there, and what it answers is what is shown.

const COMPLAINT_MS = 4000; // an error stays long enough to be read, however soon the next heat maps come

// The server's answer to a request; throws what it says against it.
async function ask(name, body) {
  let answer;
  try {
    answer = await fetch(`/api/${name}`, {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Token": TOKEN },
      body: JSON.stringify(body || {}),
    });
  } catch {
    throw new Error("The command that served this page has ended. What was picked is kept: start it again.");
  }
  if (!answer.ok) {
    const refusal = await answer.json().catch(() => ({}));
    throw new Error(refusal.error || `refused (${answer.status})`);
  }
  return answer;
}

// The JSON of the server's answer.
async function call(name, body) {
  return (await ask(name, body)).json();
}

// Show an error in the status line, and keep it there for a while.
let complainedAt = -COMPLAINT_MS;
function complain(error) {
  complainedAt = performance.now();
  show(error.message, true);
}

// Show a text in the status line.
let statusText = "";
function show(text, isWrong = false) {
  // What was still under way when the page was finished has nowhere to tell it.
  if (text === statusText || !$("status")) return;
  statusText = text;
  $("status").textContent = text;
  $("status").classList.toggle("wrong", isWrong);
}

// Send a step of work on the draft. Steps go one after the other: their order is what Undo goes back by.
let steps = Promise.resolve();
function edit(body) {
  const done = steps.then(async () => {
    const before = new Set(state.marks.map((mark) => mark.name));
    adopt(await call("edit", body));
    if (body.do === "add") choose(state.marks.map((mark) => mark.name).find((name) => !before.has(name)) || "");
    if (body.do === "rename") choose(body.new_name.trim());
  });
  steps = done.catch(complain);
  return steps;
}

// Arrow keys come many a second: one step of Undo for all that belong together.
let settling = 0;
function settle(mark) {
  clearTimeout(settling);
  const { name, u, v } = mark;
  const frame = frameOf(mark);
  settling = setTimeout(() => edit({ do: "move", name, at: { frame, u, v } }), 350);
}

// Take over the server's state of the draft, and show it.
function adopt(found) {
  Object.assign(state, found);
  if (!markOf(chosen)) chosen = "";
  renderList();
  askMatches();
  askHeat();
  draw();
}
