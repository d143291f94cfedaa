// Turns the drawing by mouse, touch and keys, and connects the controls below it.
class View {
  constructor(root) {
    const part = (name) => root.querySelector(`[data-part="${name}"]`);
    this.root = root;
    this.part = part;
    this.model = JSON.parse(part("model").textContent);
    this.canvas = part("canvas");
    this.drawing = new Drawing(this.canvas, this.model, new Float32Array(bytes(part("means"))),
      new Uint16Array(bytes(part("params"))), new Uint8Array(bytes(part("sunlit"))));
    this.exposureS = this.model.exposures_s[this.model.exposures_s.length >> 1];
    this.sunAt = (this.model.suns.length - 1) / 2;
    this.turning = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.visible = true;
    this.reset();
    this.connect();
    root.classList.add("drawn");
    new ResizeObserver(() => this.resized()).observe(this.canvas);
    new IntersectionObserver(([entry]) => { this.visible = entry.isIntersecting; this.ask(); }).observe(this.canvas);
    this.resized();
  }

  reset() {
    [this.azimuth, this.elevation] = this.model.start_rad;
    this.zoom = 1;
    this.aside = [0, 0, 0]; // m, of the point that the camera looks at, from the target's centre
  }

  resized() {
    const ratio = Math.min(devicePixelRatio || 1, 2), box = this.canvas.getBoundingClientRect();
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    this.ask();
  }

  // Returns the pose as world_to_camera has it (right, down, forward), the focal length and the principal point's size.
  camera() {
    const { model, azimuth: a, elevation: e } = this, { width, height } = this.canvas;
    const forward = [-Math.cos(e) * Math.cos(a), -Math.cos(e) * Math.sin(a), -Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const down = [0, 1, 2].map((i) => forward[(i + 1) % 3] * right[(i + 2) % 3] - forward[(i + 2) % 3] * right[(i + 1) % 3]);
    const rotation = [right, down, forward], distance = DISTANCE * model.radius_m;
    const eye = forward.map((f, i) => model.centre_m[i] + this.aside[i] - distance * f);
    const translation = rotation.map((row) => -row.reduce((sum, r, i) => sum + r * eye[i], 0));
    const focalPx = this.zoom * DISTANCE * Math.min(width, height) / 2 / FITTED;
    const scale = focalPx / distance * model.metres_per_sensor_px;
    return { rotation, translation, eye, focalPx, scale, width, height };
  }

  sun() {
    const { suns } = this.model;
    if (!suns.length) return { direction: [0, 0, 1], before: 0, after: 0, share: 0 };
    const before = Math.floor(this.sunAt), after = Math.min(before + 1, suns.length - 1), share = this.sunAt - before;
    const mixed = suns[before].map((s, i) => (1 - share) * s + share * suns[after][i]);
    const length = Math.hypot(...mixed) || 1;
    return { direction: mixed.map((x) => x / length), before, after, share };
  }

  ask() {
    if (this.asked) return;
    this.asked = requestAnimationFrame((now) => {
      this.asked = 0;
      if (this.turning && this.visible) {
        this.azimuth += (2 * Math.PI / TURN_S) * Math.min(0.1, (now - (this.last || now)) / 1000);
        this.ask();
      }
      this.last = now;
      this.draw();
    });
  }

  draw() {
    this.drawing.draw(this.camera(), this.exposureS, this.sun());
    this.mark();
    this.part("turn").setAttribute("aria-pressed", this.turning);
  }

  // Marks the Sun and the camera positions around the model.
  mark() {
    const canvas = this.part("marks"), pen = canvas.getContext("2d"), { model } = this;
    canvas.width = this.canvas.width;
    canvas.height = this.canvas.height;
    const { rotation, width, height } = this.camera(), unit = Math.min(width, height) / 2;
    const shift = [0, 1].map((k) => rotation[k].reduce((sum, r, i) => sum - r * this.aside[i], 0) / model.radius_m);
    const place = (direction, radii) => {
      const [x, y, z] = rotation.map((row) => row.reduce((sum, r, i) => sum + r * direction[i], 0));
      const factor = this.zoom * unit / FITTED;
      return [width / 2 + (radii * x + shift[0]) * factor, height / 2 + (radii * y + shift[1]) * factor, z > 0];
    };
    const ratio = this.canvas.width / Math.max(1, this.canvas.getBoundingClientRect().width);
    if (this.part("cameras") && this.part("cameras").checked) {
      for (const direction of model.cameras) {
        const [x, y, behind] = place(direction, 1.06);
        pen.fillStyle = behind ? "rgba(209,101,42,.35)" : "#e8803f";
        pen.fillRect(x - 2 * ratio, y - 2 * ratio, 4 * ratio, 4 * ratio);
      }
    }
    if (!model.suns.length) return;
    const direction = this.sun().direction, towards = rotation.map((row) => row.reduce((s, r, i) => s + r * direction[i], 0));
    const flat = Math.hypot(towards[0], towards[1]) || 1, far = 0.86 * unit * flat;
    const x = width / 2 + towards[0] / flat * far, y = height / 2 + towards[1] / flat * far;
    pen.strokeStyle = pen.fillStyle = "#f0b429";
    pen.lineWidth = 1.5 * ratio;
    pen.beginPath();
    pen.arc(x, y, 6 * ratio, 0, 2 * Math.PI);
    if (towards[2] > 0) pen.stroke(); else pen.fill(); // hollow: it stands behind the target
    pen.font = `${12 * ratio}px system-ui, sans-serif`;
    pen.fillText("Sun", x + 9 * ratio, y + 4 * ratio);
  }

  zoomBy(factor) {
    this.zoom = Math.min(ZOOM[1], Math.max(ZOOM[0], this.zoom * factor));
    this.touched();
  }

  turnBy(x, y) { // px on the page
    this.azimuth -= x * 0.008 / Math.max(1, this.zoom / 2);
    this.elevation = Math.min(HIGHEST, Math.max(-HIGHEST, this.elevation + y * 0.008 / Math.max(1, this.zoom / 2)));
    this.touched();
  }

  panBy(x, y) { // px on the page; the point looked at stays within the model
    const { rotation, focalPx } = this.camera(), { radius_m: radius } = this.model;
    const metres = DISTANCE * radius / focalPx * (this.canvas.width / this.canvas.getBoundingClientRect().width);
    const moved = this.aside.map((a, i) => a - metres * (x * rotation[0][i] + y * rotation[1][i]));
    const length = Math.hypot(...moved);
    this.aside = length > radius ? moved.map((m) => m * radius / length) : moved;
    this.touched();
  }

  touched() {
    this.turning = false;
    this.ask();
  }

  connect() {
    const { canvas, part } = this, down = new Map();
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); down.set(e.pointerId, e); });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => down.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const before = down.get(e.pointerId);
      if (!before) return;
      const [x, y] = [e.clientX - before.clientX, e.clientY - before.clientY];
      if (down.size === 2) {
        const [other] = [...down.values()].filter((p) => p.pointerId !== e.pointerId);
        const apart = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY) || 1;
        this.zoomBy(apart(e) / apart(before));
      } else if (e.shiftKey || e.buttons === 2) this.panBy(x, y);
      else this.turnBy(x, y);
      down.set(e.pointerId, e);
    });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoomBy(Math.exp(-Math.max(-120, Math.min(120, e.deltaY)) / 500));
    }, { passive: false });
    const keys = { ArrowLeft: [20, 0], ArrowRight: [-20, 0], ArrowUp: [0, 20], ArrowDown: [0, -20] };
    canvas.addEventListener("keydown", (e) => {
      if (keys[e.key]) this.turnBy(...keys[e.key]);
      else if (e.key === "+" || e.key === "-") this.zoomBy(e.key === "+" ? 1.2 : 1 / 1.2);
      else return;
      e.preventDefault();
    });
    part("reset").addEventListener("click", () => { this.reset(); this.touched(); });
    part("turn").addEventListener("click", () => { this.turning = !this.turning; this.last = 0; this.ask(); });
    part("save").addEventListener("click", () => {
      this.draw();
      const link = document.createElement("a");
      link.download = "model.png";
      link.href = canvas.toDataURL("image/png");
      link.click();
    });
    part("exposure").addEventListener("input", (e) => this.exposeFor(2 ** e.target.value));
    for (const button of this.root.querySelectorAll("[data-exposure]"))
      button.addEventListener("click", () => this.exposeFor(Number(button.dataset.exposure)));
    if (part("sun")) part("sun").addEventListener("input", (e) => { this.sunAt = Number(e.target.value); this.ask(); });
    if (part("cameras")) part("cameras").addEventListener("input", () => this.ask());
    this.exposeFor(this.exposureS);
  }

  exposeFor(seconds) {
    this.exposureS = seconds;
    this.part("exposure").value = Math.log2(seconds);
    const text = this.model.nominal ? `brightness x ${seconds.toPrecision(2)}` : `${Number((1e3 * seconds).toPrecision(3))} ms`;
    this.part("exposed").textContent = text;
    this.ask();
  }
}

window.splatViews = [];
for (const root of document.querySelectorAll(".splats")) {
  try {
    window.splatViews.push(new View(root));
  } catch (error) {
    root.dataset.refused = error.message; // the turntable picture stays
  }
}
