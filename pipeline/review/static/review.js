// The page of `reseau review`. It shows what the server says and sends decisions back; nothing is kept here.

import { fitDrawing, openDrawing, zoomDrawing } from "./draw.js";
import { COARSE_STEP, View, ask, bitmap, by, colour, guarded, json, tell } from "./view.js";

const FILTERS = ["question", "verdict", "status", "code", "camera", "folder"];
const VIEWS = ["mark-view", "pose-view", "frame-view", "whole-view", "near-view", "facts-view", "tries-view", "draw-view"];
const CLICK_HALF_PX = 40; // of the window about a coarse click
const PAGE = 100; // questions that the server gives at a time
const POLL_MS = 3000; // after which another window's decisions are known here

const state = {
  entries: [], start: 0, at: -1, page: null, mark: null, frame: null, poses: [], clicks: new Map(), named: "", trial: null,
  overlay: true, generation: 0, ahead: new Map(), // ahead: what is fetched of the next marks, by key
  opened: null, // what the server said first
  click: null, // what clicks in a whole scan are for: its camera's marks, or a frame that was not found
};

const views = {
  mark: new View(by("mark"), (col, row) => decideMark("place", { col_px: col, row_px: row })),
  surroundings: new View(by("surroundings"), null),
  whole: new View(by("whole"), (col, row) => clickedWhole(col, row), true),
  near: new View(by("near"), (col, row) => clickedNear(col, row)),
};

// --- the queue

const values = () => {
  const told = Object.fromEntries(FILTERS.map((name) => [name, by(name).value]));
  return { ...told, search: by("search").value };
};

async function refresh(keep = true) {
  take(await json("/api/queue", { ...values(), start: state.start }), keep);
}

function take(page, keep = true) {
  const key = state.entries[state.at]?.key;
  const changed = JSON.stringify(page) !== JSON.stringify(state.page);
  state.page = page;
  state.entries = page.entries;
  if (keep && key) state.at = state.entries.findIndex((entry) => entry.key === key);
  if (changed) showQueue();
}

function showQueue() {
  const { left, optional, total, shown, shown_left: shownLeft, start } = state.page;
  const kinds = [["camera", "cameras"], ["pose", "scan orientations"], ["frame", "frames"], ["mark", "marks"]];
  const parts = kinds.filter(([one]) => left[one]).map(([one, many]) => `${left[one]} ${left[one] === 1 ? many.slice(0, -1) : many}`);
  const done = total ? "No open questions. Run reseau measure." : optional ? "No question needs an answer" : "Nothing to decide yet.";
  const more = optional ? `; ${optional} optional` : "";
  by("left").textContent = (left.all ? `${left.all} left: ${parts.join(", ")}` : done) + more;
  by("progress").max = Math.max(total, 1);
  by("progress").value = total ? total - left.all : 1;
  const last = start + state.entries.length;
  by("shown").textContent = shown ? `${start + 1} to ${last} of ${shown}, ${shownLeft} left` : "nothing";
  by("earlier").disabled = start === 0;
  by("later").disabled = last >= shown;
  by("queue").replaceChildren(...state.entries.map((entry, index) => queueItem(entry, index)));
}

function queueItem(entry, index) {
  const item = document.createElement("li");
  const button = document.createElement("button");
  const small = document.createElement("small");
  button.type = "button";
  button.append(title(entry), small);
  small.textContent = entry.answer ? short(entry.answer) : entry.status || entry.verdict || (entry.is_left ? "not known" : "as learned");
  button.classList.toggle("done", !isLeft(entry));
  button.setAttribute("aria-current", index === state.at);
  button.addEventListener("click", () => open(index));
  item.append(button);
  return item;
}

const short = ({ decision, pose, image, who }) => `${pose ? `scan orientation ${pose}` : decision}${decision === "learn" ? ` from ${image}` : ""}, ${who}`;
const isLeft = (entry) => entry.is_left && !entry.answer;

function title(entry) {
  if (entry.question === "camera") return `${entry.camera}: how its marks look`;
  if (entry.question === "mark") return `${entry.image}: ${entry.kind} ${entry.point}`;
  const more = entry.count > 1 ? ` and ${entry.count - 1} more` : "";
  return entry.question === "pose" ? `${entry.image}${more}: scan orientation` : `${entry.image}: no mark was found`;
}

async function open(index) {
  await guarded(async () => {
    state.at = index;
    state.generation += 1;
    state.clicks = new Map();
    state.mark = state.frame = state.trial = state.click = null; // what is not shown yet cannot be decided
    for (const view of Object.values(views)) Object.assign(view, { cursor: null });
    showQueue();
    by("queue").children[index]?.scrollIntoView({ block: "nearest" });
    const entry = state.entries[index];
    for (const id of VIEWS) by(id).hidden = true;
    by("note").value = "";
    by("title").textContent = entry ? title(entry) : "No open questions";
    by("reason").textContent = entry ? entry.reason : "";
    showAnswer(entry);
    if (!entry) return;
    if (entry.question === "mark") await openMark(entry, state.generation);
    if (entry.question === "pose") await openPose(entry, state.generation);
    if (entry.question === "camera") await openCamera(entry, state.generation);
    if (entry.question === "frame") await openFrame(entry, state.generation);
    if (entry.question !== "mark") prefetch(index);
  });
}

function showAnswer(entry) {
  const told = entry?.answer ?? entry?.old;
  const what = told && `${short({ ...told, who: `by ${told.who}` }).replace(", by", " by")}, ${told.when}`;
  by("decided").classList.toggle("old", Boolean(entry?.old));
  by("decided").textContent = !told ? "" : entry.answer ? `Decided: ${what}` : `Decided before, about another result: ${what}. Please look again.`;
}

// What could not be fetched is null there, and asked for again when it is opened.
function prefetch(index) {
  const ahead = state.entries.slice(index + 1, index + 4).filter((entry) => entry.question === "mark");
  const kept = ahead.map((entry) => [entry.key, state.ahead.get(entry.key) ?? fetched(entry).catch(() => null)]);
  state.ahead = new Map(kept);
  const next = state.entries[index + 1];
  if (next && ["pose", "frame"].includes(next.question)) ask("/api/frame.png", { image: next.image }).catch(() => {}); // is kept there
}

// A mark and its picture, as they are shown first.
async function fetched(entry) {
  const mark = await markOf(entry);
  const view = new View({ width: by("mark").width, height: by("mark").height }, null);
  view.zoom = zoomOf(mark, by("mark").width);
  view.center = mark.place;
  view.draw = () => {};
  await view.load(mark.image);
  return { mark, view };
}

async function step(by_) {
  const next = state.at + by_;
  if (next >= state.entries.length && state.start + state.entries.length < state.page.shown) return turn(1, 0);
  if (next < 0 && state.start > 0) return turn(-1, -1);
  if (next >= 0 && next < state.entries.length) await open(next);
}

async function turn(pages, index) {
  await guarded(async () => {
    state.start = Math.max(0, state.start + pages * PAGE);
    await refresh(false);
    await open(index < 0 ? state.entries.length - 1 : index);
  });
}

async function nextLeft() {
  const rest = state.entries.findIndex((entry, index) => index > state.at && isLeft(entry));
  const first = rest >= 0 ? rest : state.entries.findIndex(isLeft);
  if (first >= 0) return open(first);
  return state.page.next_left >= 0 ? openAt(state.page.next_left) : open(state.at);
}

// at: among all that filters let through.
async function openAt(at) {
  const pages = Math.floor(at / PAGE) - state.start / PAGE;
  return turn(pages, at % PAGE);
}

// --- deciding

// key: of a question about several frames, for all of which the decisions are.
async function decide(decisions, advance = true, key = "") {
  await guarded(async () => {
    state.ahead.delete(state.entries[state.at]?.key); // what was decided about it is another now
    take(await json("/api/decide", { ...values(), start: state.start }, { decisions, key }));
    if (advance) await nextLeft();
    else await open(state.at);
  });
}

function seenWindow(view) {
  const [left, top] = view.scan(0, 0);
  return [left, top, view.canvas.width / view.zoom, view.canvas.height / view.zoom].map((value) => Math.round(value * 10) / 10);
}

function decideMark(decision, rest = {}) {
  const entry = state.entries[state.at];
  if (entry?.question !== "mark" || !state.mark) return;
  const { image, point, kind, fingerprint } = state.mark;
  const note = by("note").value.trim();
  return decide([{ image, point, kind, decision, fingerprint, note, window: seenWindow(views.mark), ...rest }]);
}

function decidePose(pose) {
  const entry = state.entries[state.at];
  const { image, fingerprint } = entry;
  if (entry.question === "pose") return decide([{ image, decision: "pose", pose, fingerprint }], true, wholeRoll(entry));
  const again = state.frame.decided.some((one) => one.decision === "pose" && one.pose === pose);
  return decide([again ? { image, decision: "undo" } : { image, decision: "pose", pose, fingerprint }], false);
}

const wholeRoll = (entry) => (entry.question === "pose" && by("roll").checked ? entry.key : "");

async function undo() {
  const entry = state.entries[state.at];
  if (!entry) return;
  const answer = entry.answer ?? entry.old;
  if (!answer) {
    const last = [...state.entries.keys()].reverse().find((index) => index < state.at && state.entries[index].answer);
    if (last === undefined) return tell("There is nothing to undo here.");
    state.at = last;
    return undo();
  }
  const { image } = entry;
  let about = [answer.decision === "pose" ? {} : entry];
  if (entry.question === "frame") about = state.frame?.decided ?? [];
  if (entry.question === "camera") about = [{ image: answer.image, kind: "learned" }];
  const lines = about.map((one) => ({ image: one.image ?? image, point: one.point ?? "", kind: one.kind ?? "", decision: "undo" }));
  await decide(lines.length ? lines : [{ image, decision: "undo" }], false, wholeRoll(entry));
}

// --- a mark

const markOf = (entry) => json("/api/mark", { image: entry.image, point: entry.point, kind: entry.kind });
const zoomOf = (mark, width) => Math.max(1, width / (2 * mark.half));

async function openMark(entry, generation) {
  const { mark, view } = (await state.ahead.get(entry.key)) ?? (await fetched(entry));
  if (generation !== state.generation) return;
  state.mark = mark;
  for (const id of ["mark-view", "facts-view"]) by(id).hidden = false;
  by("accept").disabled = !mark.can_accept;
  by("reject").disabled = !mark.can_accept;
  Object.assign(views.mark, { zoom: view.zoom, center: view.center, picture: view.picture, wanted: view.wanted });
  views.mark.marks = (pen) => drawMark(views.mark, pen, mark);
  views.surroundings.zoom = views.mark.zoom / 8;
  views.surroundings.center = mark.place;
  views.surroundings.marks = (pen) => views.surroundings.cross(pen, mark.place, colour("measured"), 6, 16);
  views.mark.draw();
  by("mark").focus({ preventScroll: true });
  showFacts(mark);
  prefetch(state.at);
  await Promise.all([views.surroundings.load(mark.image), showResidual(mark, generation), showOthers(mark, generation)]);
}

function drawMark(view, pen, mark) {
  if (!state.overlay) return;
  for (const outline of mark.outlines) view.line(pen, outline, colour("outline"), 1);
  if (mark.predicted) view.cross(pen, mark.predicted, colour("predicted"), 8, 14);
  if (mark.center && mark.covariance) {
    view.cross(pen, mark.center, colour("measured"), 6, 18);
    view.line(pen, ellipse(mark, view.zoom), colour("measured"), 1.5);
  }
  const placed = mark.decided.find((one) => one.decision === "place" && one.point === mark.point && one.kind === mark.kind);
  if (placed) view.cross(pen, [placed.col_px, placed.row_px], "#facc15", 4, 14);
}

function ellipse(mark, zoom) {
  const [[a, b], [, c]] = mark.covariance;
  const mean = (a + c) / 2;
  const half = Math.hypot((a - c) / 2, b);
  const turn = Math.atan2(2 * b, a - c) / 2;
  const axes = [Math.sqrt(Math.max(mean + half, 0)), Math.sqrt(Math.max(mean - half, 0))];
  const larger = Math.max(3, 4 / (zoom * Math.max(axes[0], 1e-6))); // a smaller one would not be seen
  return Array.from({ length: 49 }, (_, k) => {
    const [u, v] = [Math.cos((k * Math.PI) / 24) * axes[0] * larger, Math.sin((k * Math.PI) / 24) * axes[1] * larger];
    return [mark.center[0] + u * Math.cos(turn) - v * Math.sin(turn), mark.center[1] + u * Math.sin(turn) + v * Math.cos(turn)];
  });
}

const FIGURES = { // [words, unit]
  snr: ["signal-to-noise ratio", ""],
  likeness: ["correlation", ""],
  damaged_fraction: ["damaged fraction", ""],
};

function showFacts(mark) {
  const facts = [["status", mark.status], ["camera", mark.camera], ["verdict of the scan", mark.verdict]];
  if (mark.center) facts.push(["column, row", `${mark.center.map((value) => value.toFixed(2)).join(", ")} px`]);
  if (mark.covariance) facts.push(["standard deviations", `${[0, 1].map((k) => Math.sqrt(mark.covariance[k][k]).toFixed(3)).join(", ")} px`]);
  const parts = mark.causes.filter(({ sigma_px: sigma }) => sigma >= 0.0005); // half of the last digit
  for (const { cause, sigma_px: sigma } of parts.slice(0, 5)) facts.push([`of which ${cause}`, `${sigma.toFixed(3)} px`]);
  for (const [name, [words, unit]] of Object.entries(FIGURES)) {
    if (name in mark.quality) facts.push([words, mark.quality[name].toPrecision(3) + unit]);
  }
  by("facts").replaceChildren(
    ...facts.flatMap(([name, value]) => {
      const [term, told] = [document.createElement("dt"), document.createElement("dd")];
      term.textContent = name;
      told.textContent = value;
      return [term, told];
    }),
  );
}

async function showResidual(mark, generation) {
  by("residual-view").hidden = !mark.has_residual;
  if (!mark.has_residual) return;
  const shown = await bitmap("/api/residual.png", { image: mark.image, point: mark.point, kind: mark.kind });
  if (generation !== state.generation) return;
  const pen = by("residual").getContext("2d");
  pen.imageSmoothingEnabled = false;
  pen.drawImage(shown, 0, 0, by("residual").width, by("residual").height);
}

async function showOthers(mark, generation) {
  const figures = await Promise.all(
    mark.others.map(({ image, place, half }) => smallPicture(image, place, half, image, `mark ${mark.point} in ${image}`)),
  );
  if (generation !== state.generation) return;
  by("others-view").hidden = !figures.length;
  by("others").replaceChildren(...figures);
}

async function smallPicture(image, place, half, caption, label, marks = () => {}) {
  const [figure, canvas, told] = ["figure", "canvas", "figcaption"].map((tag) => document.createElement(tag));
  canvas.width = canvas.height = 106;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", label);
  told.textContent = caption;
  figure.append(canvas, told);
  const view = new View(canvas, null);
  view.zoom = 106 / (2 * half);
  view.center = place;
  view.marks = (pen) => marks(view, pen);
  await view.load(image);
  return figure;
}

// --- a pose

async function openPose(entry, generation) {
  by("pose-view").hidden = by("pose-row").hidden = false;
  by("pose-told").textContent = "Scan orientation: choose the picture that is upright and not mirrored.";
  by("roll-label").hidden = entry.count === 1;
  by("roll-told").textContent = `The same for all ${entry.count} frames of the roll`;
  const frame = await json("/api/frame", { image: entry.image });
  if (generation !== state.generation) return;
  state.frame = frame;
  showPoses(entry, frame);
  await showWhole(frame, generation);
}

// The frame of a mark that is looked at: the whole scan, and how it lies.
async function showFrame() {
  const [entry, generation] = [state.entries[state.at], state.generation];
  if (entry?.question !== "mark") return;
  if (!by("whole-view").hidden) {
    by("whole-view").hidden = by("pose-view").hidden = true;
    state.frame = null;
    return;
  }
  await guarded(async () => {
    const frame = await json("/api/frame", { image: entry.image });
    if (generation !== state.generation) return;
    state.frame = frame;
    by("pose-view").hidden = false;
    by("roll-label").hidden = by("pose-row").hidden = true;
    by("pose-told").textContent = "How the scan lies. Choose another picture only if that one is upright and not mirrored; once more takes it back.";
    showPoses(entry, frame);
    await showWhole(frame, generation);
    by("whole-view").scrollIntoView({ block: "nearest" });
  });
}

function showPoses(entry, frame) {
  const chosen = frame.decided.find((one) => one.decision === "pose")?.pose ?? (frame.pose?.decided ? frame.pose.name : "");
  by("poses").replaceChildren(
    ...state.poses.map((pose, index) => {
      const [button, picture, told, key] = ["button", "img", "span", "kbd"].map((tag) => document.createElement(tag));
      button.type = "button";
      picture.src = `/api/pose.png?${new URLSearchParams({ image: entry.image, pose })}`;
      picture.alt = `as it appears with scan orientation ${pose}`;
      told.textContent = `${pose}${pose === frame.pose?.name && !frame.pose.decided ? " (assumed)" : ""} `;
      key.textContent = index + 1;
      button.append(picture, told, key);
      button.setAttribute("aria-pressed", pose === chosen);
      button.addEventListener("click", () => decidePose(pose));
      return button;
    }),
  );
}

async function showWhole(frame, generation) {
  by("whole-view").hidden = false;
  by("words").textContent = frame.writing?.length ? `Read on the film: ${frame.writing.map(({ text }) => text).join(" · ")}` : "";
  const view = views.whole;
  view.marks = (pen) => drawFrame(view, pen, frame);
  await view.showWhole(frame.image, frame.size, () => generation === state.generation);
}

function drawFrame(view, pen, frame) {
  for (const { outline } of frame.writing ?? []) view.line(pen, outline, colour("writing"));
  const found = state.trial?.marks ?? frame.marks.filter((mark) => mark.kind === "fiducial");
  for (const { point, status, center, place } of found) {
    const at = center ?? place;
    if (!at) continue;
    const good = status === "measured" || status === "weak";
    view.cross(pen, at, good ? colour("measured") : colour("predicted"), 3, 10);
    view.name(pen, at, point, "#fff");
  }
  for (const [point, at] of state.clicks) {
    view.cross(pen, at, "#facc15", 4, 14);
    view.name(pen, at, point, "#facc15");
  }
}

// --- clicks in a whole scan: of a frame in which nothing was found, or of marks that are to be learned

async function openFrame(entry, generation) {
  const frame = await json("/api/frame", { image: entry.image });
  if (generation !== state.generation) return;
  for (const { decision, point, col_px: col, row_px: row } of frame.decided) {
    if (decision === "place") state.clicks.set(point, [col, row]);
  }
  state.click = { points: Object.keys(frame.fiducials), places: frame.fiducials, least: 3, half: CLICK_HALF_PX, tries: tryFrame, kept: keptFrame };
  by("click-told").textContent = "Choose a mark, click near it in the scan, then exactly in the window next to it. Three marks find the frame.";
  by("scan-label").hidden = by("learned-row").hidden = true;
  await clickIn(frame, generation);
}

async function openCamera(entry, generation) {
  const camera = await json("/api/camera", { key: entry.key });
  if (generation !== state.generation) return;
  const shown = entry.answer?.image ?? camera.images[0];
  state.clicks = new Map(Object.entries(entry.answer?.px ?? {}));
  const points = Object.keys(camera.fiducials);
  state.click = { points, places: camera.fiducials, least: points.length, tried: camera.tried, half: CLICK_HALF_PX, tries: tryCamera, kept: keptCamera };
  by("click-told").textContent = "Choose a scan that shows the marks well, and click every one of them: near it in the scan, then exactly in the window next to it.";
  by("scan-label").hidden = by("learned-row").hidden = false;
  options("scan", [...new Set([shown, ...camera.images])], false);
  await clickInScan(shown, generation);
}

async function clickInScan(image, generation) {
  const scan = await json("/api/scan", { image });
  if (generation !== state.generation) return;
  state.click.half = scan.half;
  await clickIn({ ...scan, marks: [], decided: [] }, generation);
}

function chooseScan() {
  state.clicks = new Map();
  state.trial = null;
  state.generation += 1;
  return guarded(() => clickInScan(by("scan").value, state.generation));
}

async function clickIn(frame, generation) {
  state.frame = frame;
  state.named = state.click.points[0] ?? "";
  by("frame-view").hidden = by("near-view").hidden = false;
  by("tries-view").hidden = true;
  by("trial").textContent = "";
  by("tries").replaceChildren();
  Object.assign(views.near, { picture: null, wanted: "", cursor: null, marks: () => {} });
  Object.assign(views.whole, { picture: null, cursor: null });
  views.near.draw();
  showNames();
  await showWhole(frame, generation);
  by("whole").focus({ preventScroll: true });
}

function showNames() {
  const { points, least } = state.click;
  by("names").replaceChildren(
    ...points.map((point, index) => {
      const [button, key] = ["button", "kbd"].map((tag) => document.createElement(tag));
      button.type = "button";
      button.setAttribute("role", "radio");
      button.setAttribute("aria-checked", point === state.named);
      button.append(`${point}${state.clicks.has(point) ? " ✓" : ""} `);
      key.textContent = index + 1;
      if (index < 9) button.append(key);
      button.addEventListener("click", () => nameMark(point));
      return button;
    }),
  );
  by("measure").disabled = by("keep").disabled = by("save-learned").disabled = state.clicks.size < least;
  by("forget").disabled = state.clicks.size === 0;
  drawSketch();
}

// Which mark is which: where they are in the camera's frame, seen upright.
function drawSketch() {
  const [canvas, places] = [by("sketch"), state.click.places];
  const [pen, half] = [canvas.getContext("2d"), canvas.width / 2];
  const middle = [0, 1].map((axis) => {
    const all = Object.values(places).map((place) => place[axis]);
    return (Math.min(...all) + Math.max(...all)) / 2;
  });
  const reach = Math.max(1e-6, ...Object.values(places).flatMap((place) => place.map((mm, axis) => Math.abs(mm - middle[axis]))));
  pen.clearRect(0, 0, canvas.width, canvas.height);
  pen.font = "14px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  for (const [point, [x, y]] of Object.entries(places)) {
    pen.fillStyle = point === state.named ? "#facc15" : "#fff";
    pen.fillText(point, half + ((x - middle[0]) / reach) * half * 0.84, half - ((y - middle[1]) / reach) * half * 0.84);
  }
}

function nameMark(point) {
  state.named = point;
  showNames();
  lookAt("whole");
}

// On a small screen it may stand below what is seen.
function lookAt(id) {
  by(id).focus({ preventScroll: true });
  by(id).scrollIntoView({ block: "nearest" });
}

function clickedWhole(col, row) {
  if (!state.click || !state.named) return;
  guarded(async () => {
    const view = views.near;
    state.trial = null;
    state.clicks.set(state.named, [col, row]);
    view.zoom = view.canvas.width / (2 * Math.max(state.click.half, COARSE_STEP / views.whole.zoom));
    view.center = view.cursor = [col, row];
    view.marks = (pen) => drawFrame(view, pen, { marks: [] });
    await view.load(state.frame.image);
    showNames();
    views.whole.draw();
    lookAt("near");
  });
}

function clickedNear(col, row) {
  if (!views.near.picture || !state.click || !state.named) return;
  state.clicks.set(state.named, [col, row]);
  views.near.draw();
  const next = state.click.points.find((point) => !state.clicks.has(point));
  if (next) state.named = next;
  showNames();
  views.whole.draw();
  lookAt("whole");
}

function measureClicks() {
  if (!state.click || state.clicks.size < state.click.least) return;
  by("trial").textContent = "measuring…";
  guarded(async () => {
    try {
      await state.click.tries(state.generation);
      by("keep").focus({ preventScroll: true }); // Enter keeps them
    } catch (error) {
      by("trial").textContent = "";
      throw error;
    }
  });
}

async function tryFrame(generation) {
  const clicks = [...state.clicks].map(([point, [col_px, row_px]]) => ({ point, col_px, row_px }));
  const trial = await json("/api/measure", {}, { image: state.frame.image, clicks });
  if (generation !== state.generation) return;
  state.trial = trial;
  by("trial").textContent = counted(trial);
  views.whole.draw();
}

// The scan that was clicked in first, then others with what it shows: each told as soon as it is measured.
async function tryCamera(generation) {
  const { image } = state.frame;
  const px = Object.fromEntries(state.clicks);
  const told = [];
  by("tries").replaceChildren();
  by("tries-view").hidden = false;
  for (const of of [image, ...state.click.tried.filter((name) => name !== image)]) {
    const trial = await json("/api/learn", {}, { image, px, of });
    if (generation !== state.generation) return;
    if (of === image) state.trial = trial;
    told.push(`${of}: ${counted(trial)}`);
    by("trial").textContent = told.join("\n");
    views.whole.draw();
    const found = trial.marks.filter(({ center }) => center);
    const figures = await Promise.all(
      found.map(({ point, center }) =>
        smallPicture(of, center, state.click.half, `${of}: ${point}`, `mark ${point} in ${of}`, (view, pen) => view.cross(pen, center, colour("measured"), 4, 12)),
      ),
    );
    if (generation !== state.generation) return;
    by("tries").append(...figures);
  }
}

function counted({ marks, pose, problems }) {
  const counts = {};
  for (const { status } of marks) counts[status] = (counts[status] ?? 0) + 1;
  const told = Object.entries(counts).map(([status, count]) => `${count} ${status}`).join(", ");
  return `${[told, pose && `scan orientation ${pose}`].filter(Boolean).join("; ")}. ${problems.join(" ")}`;
}

function keepClicks() {
  if (!state.click || state.clicks.size < state.click.least) return;
  return decide(state.click.kept(state.frame));
}

function keptFrame({ image, fingerprint }) {
  return [...state.clicks].map(([point, [col_px, row_px]]) => ({ image, point, kind: "fiducial", decision: "place", col_px, row_px, fingerprint }));
}

const keptCamera = ({ image }) => [{ image, kind: "learned", decision: "learn", px: Object.fromEntries(state.clicks) }];

function saveLearned() {
  return guarded(async () => {
    const body = { image: state.frame.image, px: Object.fromEntries(state.clicks), file: by("learned-file").value };
    by("trial").textContent = (await json("/api/save-learned", {}, body)).text;
  });
}

// No question is open while a camera is drawn.
function drawCamera() {
  return guarded(async () => {
    state.generation += 1;
    Object.assign(state, { at: -1, mark: null, frame: null, trial: null, click: null, clicks: new Map() });
    showQueue();
    for (const id of VIEWS) by(id).hidden = true;
    by("title").textContent = "Draw a camera";
    by("reason").textContent = by("decided").textContent = "";
    await openDrawing(state.opened);
  });
}

const isDrawing = () => !by("draw-view").hidden;

function forgetClicks() {
  state.clicks = new Map();
  state.trial = null;
  showNames();
  views.whole.draw();
  views.near.draw();
}

// --- keys and buttons

function zoom(factor) {
  if (isDrawing()) return zoomDrawing(factor);
  const view = by("near-view").hidden ? views.mark : views.near;
  const image = state.mark?.image ?? state.frame?.image;
  if (!image || !view.picture) return;
  view.zoom = Math.min(64, Math.max(0.25, view.zoom * factor));
  return guarded(() => view.load(image));
}

function toggleOverlay() {
  state.overlay = !state.overlay;
  by("overlay").checked = state.overlay;
  views.mark.draw();
}

const KEYS = {
  a: () => by("accept").disabled || decideMark("accept"),
  r: () => by("reject").disabled || decideMark("reject"),
  n: () => decideMark("absent"),
  j: () => step(1),
  k: () => step(-1),
  u: () => undo(),
  m: () => (isDrawing() ? fitDrawing() : measureClicks()),
  o: () => toggleOverlay(),
  f: () => showFrame(),
  "+": () => zoom(2),
  "=": () => zoom(2),
  "-": () => zoom(0.5),
  c: () => by("note").focus(),
  "/": () => by("search").focus(),
  "?": () => by("help").showModal(),
  Enter: () => keepClicks(),
};

function number(index) {
  const entry = state.entries[state.at];
  if (entry && !by("pose-view").hidden && index < state.poses.length) decidePose(state.poses[index]);
  if (state.click?.points[index]) nameMark(state.click.points[index]);
}

document.addEventListener("keydown", (event) => {
  const writes = event.target.closest("input, select, textarea, dialog");
  if (event.target.id === "note" && ["Enter", "Escape"].includes(event.key)) return by("mark").focus({ preventScroll: true });
  if (event.key === "Escape" && writes) return event.target.blur();
  if (writes || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Enter" && event.target.closest("button, summary")) return;
  if (/^[1-9]$/.test(event.key)) number(Number(event.key) - 1);
  else if (event.key in KEYS) KEYS[event.key]();
  else return;
  event.preventDefault();
});

for (const [id, key] of [["accept", "a"], ["reject", "r"], ["absent", "n"], ["measure", "m"], ["keep", "Enter"], ["help-button", "?"], ["closer", "+"], ["farther", "-"], ["show-frame", "f"]]) {
  by(id).addEventListener("click", () => KEYS[key]());
}
for (const [name, work] of [["undo", undo], ["previous", () => step(-1)], ["next", () => step(1)]]) {
  for (const button of document.getElementsByClassName(name)) button.addEventListener("click", () => work());
}
by("draw").addEventListener("click", drawCamera);
by("draw-closer").addEventListener("click", () => zoom(2));
by("draw-farther").addEventListener("click", () => zoom(0.5));
by("save-learned").addEventListener("click", saveLearned);
by("forget").addEventListener("click", forgetClicks);
by("scan").addEventListener("change", chooseScan);
by("overlay").addEventListener("change", toggleOverlay);
by("earlier").addEventListener("click", () => turn(-1, 0));
by("later").addEventListener("click", () => turn(1, 0));
for (const id of ["contrast", "brightness"]) by(id).addEventListener("input", () => Object.values(views).forEach((view) => view.draw()));

async function filtered() {
  await guarded(async () => {
    state.start = 0;
    state.at = -1;
    await refresh(false);
    if (state.page.next_left >= PAGE) await openAt(state.page.next_left);
    else await open(Math.max(0, state.page.next_left));
  });
}

for (const name of FILTERS) by(name).addEventListener("change", filtered);
let typing = 0;
by("search").addEventListener("input", () => {
  clearTimeout(typing);
  typing = setTimeout(filtered, 250);
});

function options(name, choices, withAll = true) {
  by(name).replaceChildren(
    ...[...(withAll ? [""] : []), ...choices].map((value) => {
      const option = document.createElement("option");
      option.value = value;
      option.textContent = value || "all";
      return option;
    }),
  );
}

await guarded(async () => {
  const start = await json("/api/start");
  by("project").textContent = start.project;
  document.title = `review: ${start.project}`;
  state.poses = start.poses;
  state.opened = start;
  by("learned-file").value = start.file;
  const { choices } = start;
  options("question", choices.questions);
  options("verdict", choices.verdicts);
  options("status", choices.statuses);
  options("code", choices.codes);
  options("camera", choices.cameras);
  options("folder", choices.folders);
  await filtered();
  if (!start.cameras) await drawCamera();
});
setInterval(() => refresh().catch(() => {}), POLL_MS);
