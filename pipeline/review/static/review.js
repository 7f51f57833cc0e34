// The page of `reseau review`. It shows what the server says and sends decisions back; nothing is kept here.

const by = (id) => document.getElementById(id);
const FILTERS = ["question", "verdict", "status", "code", "camera", "folder"];
const CLICK_HALF_PX = 40; // of the window about a coarse click
const POLL_MS = 3000; // after which another window's decisions are known here
const COLOURS = { measured: "--measured", second: "--second", predicted: "--predicted", outline: "--outline" };

const state = {
  entries: [], start: 0, at: -1, page: null, mark: null, frame: null, poses: [], clicks: new Map(), named: "", trial: null,
  overlay: true, generation: 0, ahead: new Map(), // ahead: what is fetched of the next marks, by key
};

// --- asking the server

async function ask(path, values = {}, body = null) {
  const query = new URLSearchParams(values).toString();
  const options = body === null ? {} : { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  const answer = await fetch(query ? `${path}?${query}` : path, { ...options, credentials: "same-origin" });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

const json = async (path, values, body) => (await ask(path, values, body)).json();
const bitmap = async (path, values) => createImageBitmap(await (await ask(path, values)).blob());

function tell(message) {
  by("told").textContent = message;
}

async function guarded(work) {
  tell("");
  try {
    await work();
  } catch (error) {
    tell(error instanceof TypeError ? `The server does not answer: ${error.message}` : error.message);
  }
}

// --- a picture of a part of a scan, in the scan's own pixels

class View {
  constructor(canvas, place) {
    this.canvas = canvas;
    this.place = place; // (col, row) => what a click does
    this.zoom = 4;
    this.center = [0, 0];
    this.picture = null;
    this.cursor = null;
    this.marks = () => {};
    this.wanted = "";
    if (place) {
      canvas.addEventListener("click", (event) => {
        const box = canvas.getBoundingClientRect();
        const x = ((event.clientX - box.left - canvas.clientLeft) * canvas.width) / canvas.clientWidth;
        const y = ((event.clientY - box.top - canvas.clientTop) * canvas.height) / canvas.clientHeight;
        this.place(...this.scan(x, y));
      });
      canvas.addEventListener("keydown", (event) => this.key(event));
      canvas.addEventListener("blur", () => this.draw());
    }
  }

  canvasXY(col, row) {
    const { width, height } = this.canvas;
    return [(col - this.center[0]) * this.zoom + width / 2, (row - this.center[1]) * this.zoom + height / 2];
  }

  scan(x, y) {
    const { width, height } = this.canvas;
    return [(x - width / 2) / this.zoom + this.center[0], (y - height / 2) / this.zoom + this.center[1]];
  }

  async load(image) {
    const needed = this.canvas.width / this.zoom + 2;
    let size = 64;
    while (size < needed) size *= 2;
    const step = Math.max(1, Math.floor(size / 480));
    const [col, row] = this.center.map((value) => Math.round(value - size / 2));
    const wanted = JSON.stringify([image, col, row, size]);
    if (wanted === this.wanted) return this.draw();
    this.wanted = wanted;
    const picture = await bitmap("/api/window.png", { image, col, row, size });
    if (this.wanted !== wanted) return; // another one was asked for meanwhile
    this.picture = { bitmap: picture, col, row, step };
    this.draw();
  }

  draw() {
    const pen = this.canvas.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.filter = "none";
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    if (this.picture) {
      const { bitmap: shown, col, row, step } = this.picture;
      pen.imageSmoothingEnabled = step * this.zoom < 1;
      pen.filter = `brightness(${by("brightness").value}%) contrast(${by("contrast").value}%)`;
      pen.drawImage(shown, ...this.canvasXY(col - 0.5, row - 0.5), shown.width * step * this.zoom, shown.height * step * this.zoom);
      pen.filter = "none";
    }
    this.marks(pen);
    this.canvas.dataset.cursor = this.cursor ? JSON.stringify(this.cursor) : "";
    if (this.cursor && document.activeElement === this.canvas) this.cross(pen, this.cursor, "#facc15", 5, 16);
  }

  cross(pen, [col, row], colour, from, to) {
    const [x, y] = this.canvasXY(col, row);
    for (const [width, stroke] of [[4, "#0009"], [2, colour]]) {
      pen.lineWidth = width;
      pen.strokeStyle = stroke;
      pen.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        pen.moveTo(x + from * dx, y + from * dy);
        pen.lineTo(x + to * dx, y + to * dy);
      }
      pen.stroke();
    }
  }

  line(pen, points, colour, width = 1.5) {
    pen.lineWidth = width;
    pen.strokeStyle = colour;
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.canvasXY(...point));
    pen.closePath();
    pen.stroke();
  }

  name(pen, [col, row], text, colour) {
    const [x, y] = this.canvasXY(col, row);
    pen.font = "14px system-ui, sans-serif";
    pen.lineWidth = 4;
    pen.strokeStyle = "#000c";
    pen.strokeText(text, x + 9, y - 9);
    pen.fillStyle = colour;
    pen.fillText(text, x + 9, y - 9);
  }

  key(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in steps) {
      const px = (this.zoom < 1 ? 4 / this.zoom : 1) * (event.shiftKey ? 0.1 : 1);
      this.cursor = (this.cursor ?? this.center).map((value, axis) => value + px * steps[event.key][axis]);
    } else if (event.key === "Enter" && this.cursor) {
      this.place(...this.cursor);
    } else {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
    this.draw();
  }
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(COLOURS[name]).trim();

const views = {
  mark: new View(by("mark"), (col, row) => decideMark("place", { col_px: col, row_px: row })),
  surroundings: new View(by("surroundings"), null),
  whole: new View(by("whole"), (col, row) => clickedWhole(col, row)),
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
  const { left, total, shown, shown_left: shownLeft, start } = state.page;
  const kinds = [["pose", "poses"], ["frame", "frames"], ["mark", "marks"]];
  const parts = kinds.filter(([one]) => left[one]).map(([one, many]) => `${left[one]} ${left[one] === 1 ? one : many}`);
  by("left").textContent = left.all ? `${left.all} left: ${parts.join(", ")}` : "Nothing is left. Run reseau measure.";
  by("progress").max = Math.max(total, 1);
  by("progress").value = total - left.all;
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
  const answer = entry.answer;
  small.textContent = answer ? `${answer.decision}${answer.pose ? ` ${answer.pose}` : ""}, ${answer.who}` : entry.status || entry.verdict;
  button.classList.toggle("done", Boolean(answer));
  button.setAttribute("aria-current", index === state.at);
  button.addEventListener("click", () => open(index));
  item.append(button);
  return item;
}

function title(entry) {
  if (entry.question === "mark") return `${entry.images[0]}: ${entry.kind} ${entry.point}`;
  const more = entry.count > 1 ? ` and ${entry.count - 1} more` : "";
  return entry.question === "pose" ? `${entry.images[0]}${more}: how it lies` : `${entry.images[0]}: no mark was found`;
}

async function open(index) {
  await guarded(async () => {
    state.at = index;
    state.generation += 1;
    state.clicks = new Map();
    state.mark = state.frame = state.trial = null; // what is not shown yet cannot be decided
    for (const view of Object.values(views)) Object.assign(view, { cursor: null });
    showQueue();
    by("queue").children[index]?.scrollIntoView({ block: "nearest" });
    const entry = state.entries[index];
    for (const id of ["mark-view", "pose-view", "frame-view", "whole-view", "near-view", "facts-view"]) by(id).hidden = true;
    by("title").textContent = entry ? title(entry) : "Nothing is left";
    by("reason").textContent = entry ? entry.reason : "";
    showAnswer(entry);
    if (!entry) return;
    if (entry.question === "mark") await openMark(entry, state.generation);
    if (entry.question === "pose") await openPose(entry, state.generation);
    if (entry.question === "frame") await openFrame(entry, state.generation);
  });
}

function showAnswer(entry) {
  const told = entry?.answer ?? entry?.old;
  const what = told && `${told.decision}${told.pose ? ` ${told.pose}` : ""} by ${told.who}, ${told.when}`;
  by("decided").classList.toggle("old", Boolean(entry?.old));
  by("decided").textContent = !told ? "" : entry.answer ? `Decided: ${what}` : `Decided before, about another result: ${what}. Please look again.`;
}

function prefetch(index) {
  const ahead = state.entries.slice(index + 1, index + 4).filter((entry) => entry.question === "mark");
  const kept = ahead.map((entry) => [entry.key, state.ahead.get(entry.key) ?? fetched(entry)]);
  state.ahead = new Map(kept);
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
    state.start = Math.max(0, state.start + pages * 100);
    await refresh(false);
    await open(index < 0 ? state.entries.length - 1 : index);
  });
}

async function nextLeft() {
  const rest = state.entries.findIndex((entry, index) => index > state.at && !entry.answer);
  const first = rest >= 0 ? rest : state.entries.findIndex((entry) => !entry.answer);
  if (first >= 0) return open(first);
  const more = state.page.shown_left > 0 && state.start + state.entries.length < state.page.shown;
  return more ? turn(1, 0) : open(state.at);
}

// --- deciding

async function decide(decisions, advance = true) {
  await guarded(async () => {
    state.ahead.delete(state.entries[state.at]?.key); // what was decided about it is another now
    take(await json("/api/decide", { ...values(), start: state.start }, { decisions }));
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
  return decide([{ image, point, kind, decision, fingerprint, window: seenWindow(views.mark), ...rest }]);
}

function decidePose(pose) {
  const entry = state.entries[state.at];
  const images = by("roll").checked ? entry.images : entry.images.slice(0, 1);
  return decide(images.map((image, index) => ({ image, decision: "pose", pose, fingerprint: entry.fingerprints[index] })));
}

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
  const images = entry.question === "pose" ? entry.images : entry.images.slice(0, 1);
  const about = entry.question === "frame" ? state.frame?.decided ?? [] : [entry];
  const lines = images.flatMap((image) => about.map(({ point = "", kind = "" }) => ({ image, point, kind, decision: "undo" })));
  await decide(lines.length ? lines : [{ image: images[0], decision: "undo" }], false);
}

// --- a mark

const markOf = (entry) => json("/api/mark", { image: entry.images[0], point: entry.point, kind: entry.kind });
const zoomOf = (mark, width) => Math.max(1, width / (2 * mark.half));

async function openMark(entry, generation) {
  const { mark, view } = await (state.ahead.get(entry.key)?.catch(() => null) ?? fetched(entry)) ?? (await fetched(entry));
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
  if (mark.second) view.cross(pen, mark.second, colour("second"), 3, 8);
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

function showFacts(mark) {
  const facts = [["status", mark.status], ["camera", mark.camera], ["verdict of the scan", mark.verdict]];
  if (mark.center) facts.push(["column, row", mark.center.map((value) => value.toFixed(2)).join(", ")]);
  if (mark.covariance) facts.push(["sigmas", `${[0, 1].map((k) => Math.sqrt(mark.covariance[k][k]).toFixed(3)).join(", ")} px`]);
  for (const { cause, sigma_px: sigma } of mark.causes.slice(0, 5)) facts.push([`of which ${cause}`, `${sigma.toFixed(3)} px`]);
  for (const name of ["snr", "likeness", "damaged_fraction", "second_method_sigmas"]) {
    if (name in mark.quality) facts.push([name.replaceAll("_", " "), mark.quality[name].toPrecision(3)]);
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
    mark.others.map(async ({ image, place, half }) => {
      const [figure, canvas, caption] = ["figure", "canvas", "figcaption"].map((tag) => document.createElement(tag));
      canvas.width = canvas.height = 106;
      canvas.setAttribute("aria-label", `mark ${mark.point} in ${image}`);
      caption.textContent = image;
      figure.append(canvas, caption);
      const view = new View(canvas, null);
      view.zoom = 106 / (2 * half);
      view.center = place;
      await view.load(image);
      return figure;
    }),
  );
  if (generation === state.generation) by("others").replaceChildren(...figures);
}

// --- a pose

async function openPose(entry, generation) {
  by("pose-view").hidden = false;
  by("roll-label").hidden = entry.count === 1;
  by("roll-told").textContent = `The same for all ${entry.count} frames of the roll`;
  const frame = await json("/api/frame", { image: entry.images[0] });
  if (generation !== state.generation) return;
  state.frame = frame;
  const chosen = entry.answer?.pose ?? "";
  by("poses").replaceChildren(
    ...state.poses.map((pose, index) => {
      const [button, picture, told, key] = ["button", "img", "span", "kbd"].map((tag) => document.createElement(tag));
      button.type = "button";
      picture.src = `/api/pose.png?${new URLSearchParams({ image: entry.images[0], pose })}`;
      picture.alt = `as it is seen if its pose is ${pose}`;
      told.textContent = `${pose}${pose === frame.pose?.name ? " (assumed)" : ""} `;
      key.textContent = index + 1;
      button.append(picture, told, key);
      button.setAttribute("aria-pressed", pose === chosen);
      button.addEventListener("click", () => decidePose(pose));
      return button;
    }),
  );
  await showWhole(frame, generation);
}

async function showWhole(frame, generation) {
  by("whole-view").hidden = false;
  const view = views.whole;
  view.zoom = Math.min(by("whole").width / frame.size[0], by("whole").height / frame.size[1]);
  view.center = [frame.size[0] / 2 - 0.5, frame.size[1] / 2 - 0.5];
  view.marks = (pen) => drawFrame(view, pen, frame);
  const shown = await bitmap("/api/frame.png", { image: frame.image });
  if (generation !== state.generation) return;
  view.picture = { bitmap: shown, col: 0, row: 0, step: frame.size[0] / shown.width };
  view.draw();
}

function drawFrame(view, pen, frame) {
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

// --- a frame in which nothing was found

async function openFrame(entry, generation) {
  const frame = await json("/api/frame", { image: entry.images[0] });
  if (generation !== state.generation) return;
  state.frame = frame;
  state.named = frame.fiducials[0] ?? "";
  for (const { decision, point, col_px: col, row_px: row } of frame.decided) {
    if (decision === "place") state.clicks.set(point, [col, row]);
  }
  by("frame-view").hidden = by("near-view").hidden = false;
  by("trial").textContent = "";
  views.near.picture = null;
  views.near.draw();
  showNames();
  await showWhole(frame, generation);
  by("whole").focus({ preventScroll: true });
}

function showNames() {
  by("names").replaceChildren(
    ...state.frame.fiducials.map((point, index) => {
      const button = document.createElement("button");
      button.type = "button";
      button.setAttribute("role", "radio");
      button.setAttribute("aria-checked", point === state.named);
      button.textContent = `${point}${state.clicks.has(point) ? " ✓" : ""}${index < 9 ? `  [${index + 1}]` : ""}`;
      button.addEventListener("click", () => nameMark(point));
      return button;
    }),
  );
  by("measure").disabled = by("keep").disabled = state.clicks.size < 3;
  by("forget").disabled = state.clicks.size === 0;
}

function nameMark(point) {
  state.named = point;
  showNames();
  by("whole").focus({ preventScroll: true });
}

function clickedWhole(col, row) {
  if (state.entries[state.at]?.question !== "frame" || !state.named) return;
  guarded(async () => {
    const view = views.near;
    state.trial = null;
    state.clicks.set(state.named, [col, row]);
    view.zoom = view.canvas.width / (2 * CLICK_HALF_PX);
    view.center = view.cursor = [col, row];
    view.marks = (pen) => drawFrame(view, pen, { marks: [] });
    await view.load(state.frame.image);
    showNames();
    views.whole.draw();
    by("near").focus({ preventScroll: true });
  });
}

function clickedNear(col, row) {
  if (!views.near.picture || !state.named) return;
  state.clicks.set(state.named, [col, row]);
  views.near.draw();
  const next = state.frame.fiducials.find((point) => !state.clicks.has(point));
  if (next) state.named = next;
  showNames();
  views.whole.draw();
  by("whole").focus({ preventScroll: true });
}

function measureClicks() {
  if (state.clicks.size < 3 || state.entries[state.at]?.question !== "frame") return;
  by("trial").textContent = "measuring…";
  guarded(async () => {
    try {
      const clicks = [...state.clicks].map(([point, [col_px, row_px]]) => ({ point, col_px, row_px }));
      state.trial = await json("/api/measure", {}, { image: state.frame.image, clicks });
      const counts = {};
      for (const { status } of state.trial.marks) counts[status] = (counts[status] ?? 0) + 1;
      const told = Object.entries(counts).map(([status, count]) => `${count} ${status}`).join(", ");
      by("trial").textContent = `${told}; pose ${state.trial.pose}. ${state.trial.problems.join(" ")}`;
      by("keep").focus({ preventScroll: true }); // Enter keeps them
    } catch (error) {
      by("trial").textContent = "";
      throw error;
    }
    views.whole.draw();
  });
}

function keepClicks() {
  const entry = state.entries[state.at];
  if (state.clicks.size < 3 || entry?.question !== "frame") return;
  const { image, fingerprint } = state.frame;
  const lines = [...state.clicks].map(([point, [col_px, row_px]]) => ({ image, point, kind: "fiducial", decision: "place", col_px, row_px, fingerprint }));
  return decide(lines);
}

function forgetClicks() {
  state.clicks = new Map();
  state.trial = null;
  showNames();
  views.whole.draw();
}

// --- keys and buttons

function zoom(factor) {
  const view = views.mark;
  view.zoom = Math.min(64, Math.max(0.5, view.zoom * factor));
  return guarded(() => view.load(state.mark.image));
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
  m: () => measureClicks(),
  o: () => toggleOverlay(),
  "+": () => zoom(2),
  "=": () => zoom(2),
  "-": () => zoom(0.5),
  "/": () => by("search").focus(),
  "?": () => by("help").showModal(),
  Enter: () => keepClicks(),
};

function number(index) {
  const entry = state.entries[state.at];
  if (entry?.question === "pose" && index < state.poses.length) decidePose(state.poses[index]);
  if (entry?.question === "frame" && state.frame?.fiducials[index]) nameMark(state.frame.fiducials[index]);
}

document.addEventListener("keydown", (event) => {
  const writes = event.target.closest("input, select, textarea, dialog");
  if (event.key === "Escape" && writes) return event.target.blur();
  if (writes || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Enter" && event.target.closest("button, summary")) return;
  if (/^[1-9]$/.test(event.key)) number(Number(event.key) - 1);
  else if (event.key in KEYS) KEYS[event.key]();
  else return;
  event.preventDefault();
});

for (const [id, key] of [["accept", "a"], ["reject", "r"], ["absent", "n"], ["measure", "m"], ["keep", "Enter"], ["help-button", "?"], ["closer", "+"], ["farther", "-"]]) {
  by(id).addEventListener("click", () => KEYS[key]());
}
for (const [name, work] of [["undo", undo], ["previous", () => step(-1)], ["next", () => step(1)]]) {
  for (const button of document.getElementsByClassName(name)) button.addEventListener("click", () => work());
}
by("forget").addEventListener("click", forgetClicks);
by("overlay").addEventListener("change", toggleOverlay);
by("earlier").addEventListener("click", () => turn(-1, 0));
by("later").addEventListener("click", () => turn(1, 0));
for (const id of ["contrast", "brightness"]) by(id).addEventListener("input", () => Object.values(views).forEach((view) => view.draw()));

async function filtered() {
  await guarded(async () => {
    state.start = 0;
    state.at = -1;
    await refresh(false);
    const first = state.entries.findIndex((entry) => !entry.answer);
    await open(first >= 0 ? first : 0);
  });
}

for (const name of FILTERS) by(name).addEventListener("change", filtered);
let typing = 0;
by("search").addEventListener("input", () => {
  clearTimeout(typing);
  typing = setTimeout(filtered, 250);
});

function options(name, choices) {
  by(name).replaceChildren(
    ...["", ...choices].map((value) => {
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
  const { choices } = start;
  options("question", choices.questions);
  options("verdict", choices.verdicts);
  options("status", choices.statuses);
  options("code", choices.codes);
  options("camera", choices.cameras);
  options("folder", choices.folders);
  await filtered();
});
setInterval(() => refresh().catch(() => {}), POLL_MS);
