// Long work of the server, proposing and saving, with its progress and remaining time.

const POLL_MS = 300; // interval of progress requests, milliseconds: three a second look continuous

let isWorking = false;
let nFollowed = 0; // jobs so far, so that answers about one are not shown for the next

// Show the progress of the server's job until `unfollow`.
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

// Hide the progress when the job has ended.
function unfollow() {
  isWorking = false;
  nFollowed += 1;
  $("job").hidden = true;
  showButtons();
}

const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

// Show a job's progress and times.
function showJob(job) {
  const share = job.total ? job.done / job.total : null;
  if (share === null) $("job-bar").removeAttribute("value");
  else $("job-bar").value = share;
  const left = job.seconds_left === null ? "" : ` · about ${duration(job.seconds_left)} left`;
  const part = share === null ? "" : `${Math.floor(100 * share)} % · `;
  $("job-time").textContent = job.is_cancelled ? "cancelling …" : `${part}${duration(job.seconds)}${left}`;
  $("job-cancel").hidden = !job.can_cancel;
}

// A duration in seconds as minutes and seconds.
function duration(seconds) {
  const whole = Math.round(seconds);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${whole % 60} s`;
}

// Follow a job that was already running when the page was loaded.
async function resume(job) {
  follow(job.name === "save" ? "Saving" : "Proposing keypoints");
  try {
    while ((await call("progress")).job) await pause(POLL_MS);
  } finally {
    unfollow();
  }
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
    const answer = await call("save");
    unfollow();
    adopt(answer);
    $("saved-text").textContent = answer.summary;
    $("saved-next").textContent = answer.next;
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
  document.body.replaceChildren(Object.assign(document.createElement("main"), { textContent: "Saved. You can close this page." }));
}

function openProposals() {
  const scans = state.recordings.filter((recording) => recording.scope === "scene").map((recording) => recording.name);
  $("propose-scene").replaceChildren(...scans.map((name) => new Option(name)));
  if (scans.includes(views[0].frame[0])) $("propose-scene").value = views[0].frame[0];
  $("propose-go").disabled = !scans.length;
  $("propose-dialog").returnValue = "";
  $("propose-dialog").showModal();
}

// Request proposals when the dialog was closed by its Propose button.
async function propose() {
  if ($("propose-dialog").returnValue !== "yes") return;
  const scene = $("propose-scene").value;
  const n = Number($("propose-n").value);
  follow(`Proposing ${n} keypoints in ${scene}`);
  try {
    const answer = await call("propose", { scene, n });
    unfollow();
    adopt(answer);
    show(answer.is_cancelled ? "cancelled; no keypoints were added" : "keypoints added; Undo removes them");
    if (!answer.is_cancelled) goTo(state.marks[state.marks.length - 1]);
  } catch (error) {
    unfollow();
    complain(error);
  }
}
