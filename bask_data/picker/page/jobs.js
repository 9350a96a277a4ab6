// Long work of the server: proposing and saving, with a bar that tells how far it is and how long it still takes.

const POLL_MS = 300; // between looks at the server's progress: a bar that moves three times a second seems to move

let isWorking = false;
let nFollowed = 0; // jobs so far: what is asked for one is not shown for the next

// Show how far the server's job is, until `unfollow`.
async function follow(title) {
  const mine = ++nFollowed;
  isWorking = true;
  $("job-title").textContent = title;
  $("job-time").textContent = "";
  $("job-bar").removeAttribute("value");
  $("job-cancel").hidden = true;
  $("job-cancel").disabled = false;
  $("job").hidden = false;
  showButtons();
  while (mine === nFollowed) {
    const { job } = await call("progress").catch(() => ({ job: null }));
    if (job && mine === nFollowed) showJob(job);
    await pause(POLL_MS);
  }
}

// The job is over: take the bar away.
function unfollow() {
  isWorking = false;
  nFollowed += 1;
  $("job").hidden = true;
  showButtons();
}

const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

// The bar, and the times beside it.
function showJob(job) {
  const share = job.total ? job.done / job.total : null;
  if (share === null) $("job-bar").removeAttribute("value");
  else $("job-bar").value = share;
  const left = job.seconds_left === null ? "" : ` · about ${duration(job.seconds_left)} left`;
  const part = share === null ? "" : `${Math.floor(100 * share)} % · `;
  $("job-time").textContent = job.is_cancelled ? "ending …" : `${part}${duration(job.seconds)}${left}`;
  $("job-cancel").hidden = !job.can_cancel;
}

// Seconds as a person says them.
function duration(seconds) {
  const whole = Math.round(seconds);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${whole % 60} s`;
}

// A page that was loaded anew while the server works shows the rest of it.
async function resume(job) {
  follow(job.name === "save" ? "Saving" : "Proposing keypoints");
  while ((await call("progress")).job) await pause(POLL_MS);
  unfollow();
  adopt(await call("start"));
}

async function cancelJob() {
  $("job-cancel").disabled = true;
  const { job } = await call("cancel");
  if (job) showJob(job);
}

function showButtons() {
  $("save").disabled = isWorking || !state.marks.length || state.is_saved;
  $("propose").disabled = isWorking;
}

async function save() {
  if (isWorking || !state.marks.length || state.is_saved) return;
  follow("Saving");
  await steps;
  try {
    const found = await call("save");
    unfollow();
    adopt(found);
    $("saved-text").textContent = found.told;
    $("saved-next").textContent = found.next;
    $("saved").hidden = false;
    $("finish").focus();
    show("saved");
  } catch (error) {
    unfollow();
    complain(error);
  }
}

async function finish() {
  await call("close").catch(() => null);
  views.length = 0;
  document.removeEventListener("keydown", onKey);
  document.body.replaceChildren(Object.assign(document.createElement("main"), { textContent: "Saved. This page can be closed." }));
}

function openProposals() {
  const scans = state.recordings.filter((recording) => recording.scope === "scene").map((recording) => recording.name);
  $("propose-scene").replaceChildren(...scans.map((name) => new Option(name)));
  if (scans.includes(views[0].frame[0])) $("propose-scene").value = views[0].frame[0];
  $("propose-go").disabled = !scans.length;
  $("propose-dialog").returnValue = "";
  $("propose-dialog").showModal();
}

// Ask for proposals, once the dialog is closed by its button.
async function propose() {
  if ($("propose-dialog").returnValue !== "yes") return;
  const scene = $("propose-scene").value;
  const n = Number($("propose-n").value);
  follow(`Proposing ${n} keypoints in ${scene}`);
  try {
    const found = await call("propose", { scene, n });
    unfollow();
    adopt(found);
    show(found.is_cancelled ? "cancelled: nothing was proposed" : "proposed; Undo takes them away");
    if (!found.is_cancelled) goTo(state.marks[state.marks.length - 1]);
  } catch (error) {
    unfollow();
    complain(error);
  }
}
