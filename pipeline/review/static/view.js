// What the pages share: asking the server, and pictures of parts of scans.

export const by = (id) => document.getElementById(id);
export const COARSE_STEP = 8; // pixels of the page that an arrow key moves by in a whole scan; the window beside it shows as much about a click
const COLOURS = { measured: "--measured", writing: "--writing", predicted: "--predicted", outline: "--outline" };

// --- asking the server

export async function ask(path, values = {}, body = null) {
  const query = new URLSearchParams(values).toString();
  const options = body === null ? {} : { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  const answer = await fetch(query ? `${path}?${query}` : path, { ...options, credentials: "same-origin" });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

export const json = async (path, values, body) => (await ask(path, values, body)).json();
export const bitmap = async (path, values) => createImageBitmap(await (await ask(path, values)).blob());

export function tell(message) {
  by("told").textContent = message;
}

export async function guarded(work) {
  tell("");
  try {
    await work();
  } catch (error) {
    tell(error instanceof TypeError ? `The server does not answer: ${error.message}` : error.message);
  }
}

// --- a picture of a part of a scan, in the scan's own pixels

export class View {
  constructor(canvas, place, coarse = false) {
    this.canvas = canvas;
    this.place = place; // (col, row) => what a click does
    this.coarse = coarse; // whether arrow keys move by parts of the picture, and not by pixels of the scan
    this.zoom = 4;
    this.center = [0, 0];
    this.picture = null;
    this.cursor = null;
    this.marks = () => {};
    this.wanted = "";
    if (place) {
      canvas.addEventListener("click", (event) => this.place(...this.scan(...this.eventXY(event))));
      canvas.addEventListener("keydown", (event) => this.key(event));
      canvas.addEventListener("blur", () => this.draw());
    }
  }

  eventXY(event) {
    const { canvas } = this;
    const box = canvas.getBoundingClientRect();
    const x = ((event.clientX - box.left - canvas.clientLeft) * canvas.width) / canvas.clientWidth;
    return [x, ((event.clientY - box.top - canvas.clientTop) * canvas.height) / canvas.clientHeight];
  }

  canvasXY(col, row) {
    const { width, height } = this.canvas;
    return [(col - this.center[0]) * this.zoom + width / 2, (row - this.center[1]) * this.zoom + height / 2];
  }

  scan(x, y) {
    const { width, height } = this.canvas;
    return [(x - width / 2) / this.zoom + this.center[0], (y - height / 2) / this.zoom + this.center[1]].map((px) => Math.round(px * 100) / 100);
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

  async showWhole(image, size, isCurrent = () => true) {
    this.zoom = Math.min(this.canvas.width / size[0], this.canvas.height / size[1]);
    this.center = [size[0] / 2 - 0.5, size[1] / 2 - 0.5];
    const shown = await bitmap("/api/frame.png", { image });
    if (!isCurrent()) return;
    this.picture = { bitmap: shown, col: 0, row: 0, step: size[0] / shown.width };
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
      const px = (this.coarse ? COARSE_STEP / this.zoom : 1) * (event.shiftKey ? 0.1 : 1);
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

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(COLOURS[name]).trim();
