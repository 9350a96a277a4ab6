// Requests to the server. It keeps the draft: every step is sent to it, and the page shows its answer.

const COMPLAINT_MS = 4000; // how long an error stays legible before heat maps replace it, milliseconds

// The server's answer to a request; throws an Error with its message if it refuses.
async function ask(name, body) {
  let answer;
  try {
    answer = await fetch(`/api/${name}`, {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Token": TOKEN },
      body: JSON.stringify(body || {}),
    });
  } catch {
    throw new Error("The command behind this page has ended. Your keypoints are kept: start it again.");
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

// Show an error in the status line for at least COMPLAINT_MS.
let complainedAt = -COMPLAINT_MS;
function complain(error) {
  complainedAt = performance.now();
  show(error.message, true);
}

// Show a text in the status line.
let statusText = "";
function show(text, isError = false) {
  // Answers that arrive after Finish find no status line.
  if (text === statusText || !$("status")) return;
  statusText = text;
  $("status").textContent = text;
  $("status").classList.toggle("error", isError);
}

// Send an edit of the draft. Edits are sent one after the other, as Undo depends on their order.
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

// Combine moves by quickly repeated arrow keys into one step of Undo.
let settling = 0;
function settle(mark) {
  clearTimeout(settling);
  const { name, u, v } = mark;
  const frame = frameOf(mark);
  settling = setTimeout(() => edit({ do: "move", name, at: { frame, u, v } }), 350);
}

// Show the server's state of the draft.
function adopt(answer) {
  Object.assign(state, answer);
  if (!markOf(chosen)) chosen = "";
  renderList();
  askMatches();
  askHeat();
  draw();
}
