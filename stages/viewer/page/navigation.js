// The camera that the user moves: orbit, pan, zoom, fly; by mouse, touch and keyboard.

const TURN_PER_WIDTH = Math.PI; // radians of a drag across the whole view
const KEY_TURN = 1.2, KEY_FLY = 0.8; // radians and orbit distances a second
const WHEEL_ZOOM = 0.0012; // of the logarithm of the distance, a pixel of the wheel
const CLICK_PX = { mouse: 5, pen: 8, touch: 12 }; // that a click may move
const FLIGHT_MS = 700;
const MIN_DISTANCE = 1e-3;
const STEEPEST = 0.995; // cosine between view and up: an orbit ends before it tips over
const HELD = new Set(["w", "a", "s", "d", "q", "e", "arrowleft", "arrowright", "arrowup", "arrowdown", "+", "=", "-"]);

/** Whether a key is for the scene: not where it is typed, moves a slider or presses a button. */
function isForScene({ target, key, ctrlKey, metaKey, altKey }) {
  if (ctrlKey || metaKey || altKey || target.matches("select, [type=number]")) return false;
  const moves = key.startsWith("Arrow") && target.matches("[type=range], [type=radio]");
  return !moves && !((key === "Enter" || key === " ") && target.matches("button, summary, input"));
}

class Navigation {
  /** `changed()` is called after every move, `clicked(x, y)` with canvas pixels. */
  constructor(canvas, up, changed, clicked) {
    Object.assign(this, { canvas, up, changed, clicked, pose: null, distance: 1, pointers: new Map(), held: new Set() });
    canvas.addEventListener("pointerdown", (event) => this.pressed(event));
    canvas.addEventListener("pointermove", (event) => this.dragged(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.released(event));
    canvas.addEventListener("wheel", (event) => this.wheeled(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    document.addEventListener("keydown", (event) => this.keyed(event));
    document.addEventListener("keyup", (event) => this.keyReleased(event));
    window.addEventListener("blur", () => this.held.clear());
  }

  get target() {
    return add(this.pose.centre, scaled(forward(this.pose), this.distance));
  }

  moveTo(pose) {
    this.flight = null;
    this.pose = pose;
    this.changed();
  }

  /** Goes there smoothly, at once where the system asks for reduced motion; resolves on arrival. */
  flyTo(pose, distance = this.distance) {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    return new Promise((arrived) => {
      this.flight = { from: this.pose, to: pose, began: now(), distance: [this.distance, distance], arrived, ms: still ? 0 : FLIGHT_MS };
    });
  }

  orbit(yaw, pitch) {
    const { target } = this, level = turnedPose(this.pose, this.up, yaw, target);
    const tipped = turnedPose(level, unit(right(level)), pitch, target);
    const steep = Math.abs(dot(forward(tipped), this.up)), before = Math.abs(dot(forward(level), this.up));
    this.moveTo(steep > STEEPEST && steep > before ? level : tipped);
  }

  pan(x, y) {
    const aside = add(scaled(right(this.pose), x * this.distance), scaled(down(this.pose), y * this.distance));
    this.moveTo({ ...this.pose, centre: add(this.pose.centre, aside) });
  }

  zoom(factor) {
    const { target } = this;
    this.distance = Math.max(MIN_DISTANCE, this.distance * factor);
    this.moveTo({ ...this.pose, centre: subtract(target, scaled(forward(this.pose), this.distance)) });
  }

  fly(x, y, z) {
    const { rotation, centre } = this.pose;
    this.moveTo({ rotation, centre: add(centre, scaled(toScene(rotation, [x, y, z]), this.distance)) });
  }

  /** Turns the horizon level. */
  level() {
    const ahead = forward(this.pose);
    const aside = cross(ahead, this.up);
    if (norm(aside) < 0.1) return;
    const x = unit(aside);
    return this.flyTo({ rotation: [...x, ...cross(ahead, x), ...ahead], centre: this.pose.centre });
  }

  /** What moves by itself: a flight, held keys. */
  frame(seconds) {
    if (this.flight) {
      const { from, to, began, distance, arrived, ms } = this.flight, share = ms ? clamp((now() - began) / ms, 0, 1) : 1;
      const smooth = share * share * (3 - 2 * share);
      this.pose = share === 1 ? to : between(from, to, smooth);
      this.distance = distance[0] * (1 - smooth) + distance[1] * smooth;
      if (share === 1) this.flight = null;
      this.changed(share === 1 ? "arrived" : "flying");
      if (share === 1) arrived();
    }
    const down = (key) => (this.held.has(key) ? 1 : 0), step = KEY_FLY * seconds, turn = KEY_TURN * seconds;
    const [x, y, z] = [down("d") - down("a"), down("e") - down("q"), down("w") - down("s")];
    if (x || y || z) this.fly(step * x, -step * y, step * z);
    const yaw = down("arrowleft") - down("arrowright"), pitch = down("arrowdown") - down("arrowup");
    if (yaw || pitch) this.orbit(-turn * yaw, turn * pitch);
    const nearer = down("+") + down("=") - down("-");
    if (nearer) this.zoom(Math.exp(-nearer * seconds));
  }

  /** A key held with Shift has another name without it, and none is told of where it was held with Meta. */
  keyReleased({ key }) {
    if (key === "Shift" || key === "Meta") this.held.clear();
    this.held.delete(key.toLowerCase());
  }

  pressed(event) {
    this.canvas.focus();
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (this.pointers.size === 1) this.pressedAt = { x: event.clientX, y: event.clientY, moved: false, button: event.button };
    else this.pressedAt.moved = true;
  }

  dragged(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last || !this.pressedAt) return;
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    const away = Math.hypot(event.clientX - this.pressedAt.x, event.clientY - this.pressedAt.y);
    if (away > (CLICK_PX[event.pointerType] ?? CLICK_PX.mouse)) this.pressedAt.moved = true;
    if (!this.pressedAt.moved) return;
    if (this.pointers.size > 1) return this.pinched(event);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const { clientWidth, clientHeight } = this.canvas, size = Math.min(clientWidth, clientHeight);
    if (event.buttons & 6 || event.shiftKey) this.pan(-dx / size, -dy / size);
    else this.orbit((-dx / size) * TURN_PER_WIDTH, (-dy / size) * TURN_PER_WIDTH);
  }

  /** Two fingers: their distance zooms, their middle pans. */
  pinched(event) {
    const middle = () => {
      const [a, b] = [...this.pointers.values()];
      return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) };
    };
    const before = middle();
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const after = middle(), size = Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    if (before.apart > 0 && after.apart > 0) this.zoom(before.apart / after.apart);
    this.pan((before.x - after.x) / size, (before.y - after.y) / size);
  }

  released(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    if (event.type === "pointerup" && this.pressedAt && !this.pressedAt.moved && this.pressedAt.button === 0) {
      const box = this.canvas.getBoundingClientRect(), ratio = this.canvas.width / box.width;
      this.clicked((event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio);
    }
  }

  wheeled(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : 1);
    this.zoom(Math.exp(clamp(pixels * WHEEL_ZOOM, -0.5, 0.5)));
  }

  keyed(event) {
    const key = event.key.toLowerCase();
    if (!HELD.has(key) || !isForScene(event)) return;
    event.preventDefault();
    this.held.add(key);
  }
}
