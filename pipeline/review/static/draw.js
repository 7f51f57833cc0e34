// Drawing a camera: marks are clicked in a scan, their drawing is dragged until it leaves nothing, and saved. The server
// draws, moves handles and fits; this page holds the drawing and shows what it is told.

import { View, bitmap, by, guarded, json, tell } from "./view.js";

const NEAR_PX = 11; // of the page: so near a handle, a press takes it
const PARTS = ["disk", "ring", "bar", "polygon"];
const CAMERA = ["name", "distance", "width", "height", "pitch", "sigma"];
const LABEL_PX = [60, 16]; // room of a handle's name
const COLOUR = { line: "#22c55e", handle: "#facc15", mark: "#fff", corner: "#38bdf8" };

const drawing = { image: "", mark: null, marks: [], point: "", corners: [], placesCorners: false };
let reply = null; // what the server says of it
let overlay = null; // the rendered drawing
let drag = null;
let generation = 0;
const steps = []; // that the server has not answered yet
let isBusy = false;

const view = new View(by("draw-mark"), null);
const whole = new View(by("draw-whole"), (col, row) => clickedWhole(col, row), true);

export async function openDrawing(start) {
  by("draw-view").hidden = false;
  if (drawing.image) return whole.draw();
  fill(by("draw-scan"), start.scans);
  fill(by("draw-kind"), start.kinds);
  fill(by("draw-pose"), start.poses);
  by("draw-pose").value = start.poses.includes(start.pose) ? start.pose : "0";
  by("draw-file").value = start.file;
  by("draw-parts").replaceChildren(
    ...PARTS.map((shape) => button(`Add a ${shape}`, () => take({ part: shape }))),
  );
  await chooseScan();
}

function fill(select, values) {
  select.replaceChildren(...values.map((value) => new Option(value, value)));
}

function button(text, work) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.addEventListener("click", work);
  return made;
}

async function chooseScan() {
  await guarded(async () => {
    Object.assign(drawing, { image: by("draw-scan").value, marks: [], point: "", corners: [] });
    const scan = await json("/api/scan", { image: drawing.image });
    whole.marks = drawWhole;
    await whole.showWhole(drawing.image, scan.size);
    by("draw-whole").focus({ preventScroll: true });
  });
  await take(null);
}

// --- what is sent, and what comes back

const number = (id) => (by(`draw-${id}`).value.trim() === "" ? null : Number(by(`draw-${id}`).value));

const sent = () => ({
  image: drawing.image,
  mark: drawing.mark ?? { kind: "dot", radius_mm: 1 },
  marks: drawing.marks.map(({ id, px, xy_mm, turn_deg, blur_px, unfitted }) => ({ id, px, xy_mm, turn_deg, blur_px, unfitted })),
  point: drawing.point,
  name: by("draw-name").value.trim(),
  pose: by("draw-pose").value,
  pitch_um: number("pitch"),
  principal_distance_mm: number("distance"),
  frame_mm: [number("width"), number("height")],
  corners_px: drawing.corners.length === 2 ? drawing.corners : [],
  sigma_mm: number("sigma"),
});

// One step after another; of several drags that wait the last one counts. edit: a change of the drawing that is made
// here, when it is its turn: an earlier answer would undo it.
async function take(step, edit = () => {}) {
  const last = steps.at(-1)?.step;
  if (step?.drag && last?.drag === step.drag) steps.pop();
  steps.push({ step, edit });
  if (isBusy) return;
  isBusy = true;
  await guarded(async () => {
    try {
      while (steps.length) {
        await answered(steps.shift());
        if (!steps.length) await showPictures(); // meanwhile more may come
      }
    } finally {
      for (const one of steps.splice(0)) one.edit(); // what waits behind a refusal is kept here, and not sent
      isBusy = false;
      show();
    }
  });
}

async function answered({ step, edit }) {
  edit();
  if (!drawing.mark && !step?.kind) await answered({ step: { kind: by("draw-kind").value }, edit() {} });
  const before = reply?.shown?.center;
  reply = await json("/api/draw", {}, { drawing: sent(), step: step?.select === undefined ? step : null });
  Object.assign(drawing, { mark: reply.mark, marks: reply.marks });
  const { shown } = reply;
  if (shown && (!before || step?.kind || step?.select || step?.fit)) look(shown);
  if (step?.fit) by("draw-told").textContent = fitted();
  show();
}

function fitted() {
  const fits = reply.marks.filter(({ unfitted }) => !unfitted);
  const blurs = fits.map(({ id, blur_px: blur }) => `${id}: ${blur.toFixed(2)} px`);
  const lost = reply.marks.filter(({ unfitted }) => unfitted).map(({ id, unfitted }) => ` Not mark ${id}: ${unfitted}.`);
  const remedy = lost.length ? " Look at these, and click them again or take them out." : "";
  return `Fitted: turned by ${fits[0].turn_deg.toFixed(2).replace("-", "−")}°; blur of mark ${blurs.join(", ")}.${lost.join("")}${remedy}`;
}

function look(shown) {
  view.zoom = view.canvas.width / (2 * shown.half + 1);
  view.center = shown.center;
  view.cursor = null;
  overlay = null;
}

async function showPictures() {
  const shown = reply?.shown;
  const mine = (generation += 1);
  if (!shown) return;
  await view.load(drawing.image);
  by("draw-left-view").hidden = !shown.has_picture;
  if (!shown.has_picture) {
    overlay = null;
    return;
  }
  const about = { drawing: JSON.stringify(sent()), half: shown.half };
  const [drawn, left] = await Promise.all(["drawing", "left"].map((of) => bitmap("/api/drawing.png", { ...about, of })));
  if (mine !== generation) return;
  overlay = { drawn, start: shown.start };
  const pen = by("draw-left").getContext("2d");
  pen.imageSmoothingEnabled = false;
  pen.drawImage(left, 0, 0, by("draw-left").width, by("draw-left").height);
  by("draw-left").dataset.shown = mine;
}

// --- what is shown

function show() {
  by("draw-parts").hidden = drawing.mark?.kind !== "parts";
  by("draw-corner-row").hidden = !["parts", "polygon"].includes(drawing.mark?.kind);
  by("draw-problem").textContent = reply?.problem ?? "";
  if (reply) {
    const pitch = reply.pitch_um.map((um) => um.toFixed(2)).join(" × ");
    by("draw-pitch-told").textContent = `${pitch} µm ${reply.pitch_source}`;
    by("draw-frame-told").textContent = reply.frame_mm ? `${reply.frame_mm.join(" × ")} mm` : "not known yet";
    showForm();
  }
  showMarks();
  view.marks = drawMark;
  view.draw();
  whole.draw();
}

function showForm() {
  if (by("draw-form").contains(document.activeElement)) return; // somebody writes there
  by("draw-form").replaceChildren(
    ...reply.form.map(({ key, unit, meaning, choices, value }) => {
      const label = document.createElement("label");
      const input = document.createElement(choices.length ? "select" : "input");
      if (choices.length) fill(input, choices);
      else Object.assign(input, { type: "number", step: "any" });
      input.id = `size-${key}`;
      input.value = value;
      label.title = meaning;
      label.append(`${key.replace(/_(mm|deg)$/, "").replace("_", " ").replaceAll("_", " ")} `, input, unit ? ` ${unit}` : "");
      input.addEventListener("change", () => {
        const given = choices.length ? input.value : Number(input.value);
        input.blur();
        take(null, () => (drawing.mark = { ...drawing.mark, [key]: given }));
      });
      return label;
    }),
  );
}

function showMarks() {
  if (by("draw-marks").contains(document.activeElement)) return;
  by("draw-marks").replaceChildren(
    ...drawing.marks.map((mark) => {
      const row = document.createElement("tr");
      const cell = (content) => {
        const one = document.createElement("td");
        one.append(content);
        row.append(one);
      };
      row.setAttribute("aria-selected", mark.id === drawing.point);
      cell(button("Show", () => select(mark.id)));
      cell(field(mark.id, `name of mark ${mark.id}`, (text) => rename(mark.id, text), "text"));
      for (const axis of [0, 1]) {
        const label = `${"xy"[axis]} of mark ${mark.id}, mm`;
        const given = field(mark.xy_mm[axis] ?? "", label, (text) => give(mark.id, axis, text), "number");
        given.placeholder = mark.found_mm ? mark.found_mm[axis].toFixed(3).replace("-", "−") : "";
        cell(given);
      }
      cell(button("×", () => remove(mark.id)));
      return row;
    }),
  );
}

function field(value, label, work, type) {
  const input = document.createElement("input");
  Object.assign(input, { type, value });
  if (type === "number") input.step = "any";
  input.setAttribute("aria-label", label);
  input.addEventListener("change", () => {
    input.blur();
    work(input.value.trim());
  });
  return input;
}

function select(id) {
  return take({ select: id }, () => (drawing.point = id));
}

function edit(id, work) {
  const mark = drawing.marks.find((one) => one.id === id);
  if (mark) work(mark);
}

function rename(id, text) {
  take(null, () =>
    edit(id, (mark) => {
      if (drawing.point === id) drawing.point = text;
      mark.id = text;
    }),
  );
}

function give(id, axis, text) {
  take(null, () => edit(id, (mark) => (mark.xy_mm[axis] = text === "" ? null : Number(text))));
}

function remove(id) {
  take({ select: "" }, () => {
    drawing.marks = drawing.marks.filter((one) => one.id !== id);
    if (drawing.point === id) drawing.point = drawing.marks[0]?.id ?? "";
  });
}

function drawWhole(pen) {
  for (const { id, px } of drawing.marks) {
    whole.cross(pen, px, id === drawing.point ? COLOUR.handle : COLOUR.line, 4, 13);
    whole.name(pen, px, id, COLOUR.mark);
  }
  for (const px of drawing.corners) whole.cross(pen, px, COLOUR.corner, 0, 10);
}

function drawMark(pen) {
  if (!reply?.shown) return;
  const { outlines, handles, center } = reply.shown;
  if (by("draw-overlay").checked) {
    if (overlay) {
      const { drawn, start } = overlay;
      pen.imageSmoothingEnabled = false;
      pen.drawImage(drawn, ...view.canvasXY(start[0] - 0.5, start[1] - 0.5), drawn.width * view.zoom, drawn.height * view.zoom);
    }
    for (const outline of outlines) view.line(pen, outline, COLOUR.line, 1.5);
  }
  view.cross(pen, center, COLOUR.mark, 3, 9);
  const named = [];
  for (const { key, px } of handles) {
    const [x, y] = view.canvasXY(...px);
    const isFree = named.every(([u, v]) => Math.abs(u - x) > LABEL_PX[0] || Math.abs(v - y) > LABEL_PX[1]);
    pen.beginPath();
    pen.arc(x, y, 5, 0, 2 * Math.PI);
    pen.fillStyle = drag?.key === key ? "#fff" : COLOUR.handle;
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = "#000";
    pen.stroke();
    if (drag?.key === key || (handles.length < 8 && isFree)) {
      view.name(pen, px, key.split(".").at(-1).replace(/_(mm|deg)$/, "").replace("_", " "), COLOUR.handle);
      named.push([x, y]);
    }
  }
  view.canvas.dataset.handles = JSON.stringify(Object.fromEntries(handles.map(({ key, px }) => [key, view.canvasXY(...px)])));
  view.canvas.dataset.view = JSON.stringify({ center: view.center, zoom: view.zoom }); // for tests, which click places of the scan
}

// --- what a person does

function clickedWhole(col, row) {
  if (drawing.placesCorners) {
    drawing.corners = [...drawing.corners.slice(-1), [col, row]];
    if (drawing.corners.length === 2) setPlacesCorners(false);
    return take(null);
  }
  const near = drawing.marks.find(({ px }) => Math.hypot(px[0] - col, px[1] - row) * whole.zoom < NEAR_PX);
  if (near) return select(near.id);
  return take({ select: "" }, () => {
    let free = 1;
    while (drawing.marks.some(({ id }) => id === String(free))) free += 1;
    drawing.marks.push({ id: String(free), px: [col, row], xy_mm: [null, null], turn_deg: 0, blur_px: 0.8, unfitted: "" });
    drawing.point = String(free);
  });
}

function setPlacesCorners(on) {
  drawing.placesCorners = on;
  by("draw-corners").setAttribute("aria-pressed", on);
  if (on) drawing.corners = [];
  whole.draw();
}

// The handle under the pointer; the mark's own place counts as one, after the others.
function handleAt(x, y) {
  const places = [...(reply?.shown?.handles ?? []), { key: "place", px: reply?.shown?.center ?? [NaN, NaN] }];
  const apart = ({ px }) => Math.hypot(...view.canvasXY(...px).map((value, axis) => value - [x, y][axis]));
  const nearest = places.reduce((best, one) => (apart(one) < apart(best) ? one : best));
  return apart(nearest) < NEAR_PX ? nearest.key : null;
}

const canvas = by("draw-mark");
canvas.addEventListener("pointerdown", (event) => {
  if (!reply?.shown) return;
  canvas.setPointerCapture(event.pointerId);
  drag = { key: handleAt(...view.eventXY(event)), moved: false };
  if (drag.key && drag.key !== "place") drawing.handle = drag.key;
});
canvas.addEventListener("pointermove", (event) => {
  if (!drag?.key) return;
  drag.moved = true;
  take({ drag: drag.key, px: view.scan(...view.eventXY(event)) });
});
canvas.addEventListener("pointerup", (event) => {
  const done = drag;
  drag = null;
  if (done && !done.key) take({ click: view.scan(...view.eventXY(event)) });
  else if (done?.key === "place" && !done.moved) take({ click: reply.shown.center }); // a corner of a polygon in the mark's point
  else view.draw();
});
canvas.addEventListener("pointercancel", () => (drag = null));
view.place = (col, row) => take({ click: [col, row] });
canvas.addEventListener("keydown", (event) => view.key(event));
canvas.addEventListener("blur", () => view.draw());

export function fitDrawing() {
  by("draw-told").textContent = "fitting…";
  return take({ fit: true }).finally(() => {
    if (by("draw-told").textContent === "fitting…") by("draw-told").textContent = "";
  });
}

export function zoomDrawing(factor) {
  view.zoom = Math.min(64, Math.max(0.25, view.zoom * factor));
  return guarded(() => view.load(drawing.image));
}

function takeOut() {
  if (!drawing.handle) return tell("Drag a corner or a part first: the last one is taken out.");
  const key = drawing.handle;
  drawing.handle = "";
  return take({ remove: key });
}

function save() {
  return guarded(async () => {
    const { text } = await json("/api/save-camera", {}, { drawing: sent(), file: by("draw-file").value });
    by("draw-told").textContent = text;
  });
}

by("draw-scan").addEventListener("change", chooseScan);
by("draw-kind").addEventListener("change", () => take({ kind: by("draw-kind").value }));
by("draw-pose").addEventListener("change", () => take(null));
for (const id of CAMERA) by(`draw-${id}`).addEventListener("change", () => take(null));
by("draw-corners").addEventListener("click", () => setPlacesCorners(!drawing.placesCorners));
by("draw-overlay").addEventListener("change", () => view.draw());
by("draw-fit").addEventListener("click", fitDrawing);
by("draw-save").addEventListener("click", save);
by("draw-take-out").addEventListener("click", takeOut);
