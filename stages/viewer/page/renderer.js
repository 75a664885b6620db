// Which picture is drawn when: small ones while the view moves, by measured time, then all pixels, strip by strip.

const MOVING_MS = 30; // that a picture may take while the view moves
const STRIP_MS = 40; // that a strip may take while nothing moves
const STILL_MS = 180; // without a change until pixels fill in
const MIN_PIXELS = 64 * 48, MAX_PIXELS = 4 << 20; // of a picture
const MOVING_OPACITY_STEP = 1 / 64, OPACITY_STEP = 1 / 512; // as the Python renderer's
const MAX_GROWTH = 2; // of a picture or strip over the one before

const now = () => performance.now();

class Renderer {
  /** `request()` gives what is to be shown: {pose, lens, nearFar, view, background, logGain, falloff, crop}; `over` draws
   *  layers into it. */
  constructor(canvas, contents, request, over) {
    Object.assign(this, { canvas, contents, request, over });
    this.movingPixels = this.stripPixels = MIN_PIXELS;
    this.stripFraction = 1; // of the time that strips may take: less where a training needs the machine
    this.restore();
  }

  /** At first, and after the context was lost. */
  restore() {
    this.graphics = new Graphics(this.canvas, this.contents);
    this.coarse = this.fine = this.job = null;
    this.touch();
  }

  /** Something has changed: what is shown is out of date. */
  touch() {
    this.restsUntil = now() + STILL_MS;
    this.stale = true;
    this.keeps = false;
    this.filled = 0;
  }

  /** The field is another. A view that rests keeps its picture, in which the new one fills in. */
  load(contents) {
    this.contents = contents;
    this.graphics.load(contents);
    if (!this.isDone) return this.touch();
    this.keeps = true;
    this.filled = 0;
  }

  /** Everything that is left to do at this frame of the screen. */
  frame() {
    if (this.graphics.gl.isContextLost()) return;
    this.fitCanvas();
    if (this.job && !this.finished()) return;
    if (this.stale) this.drawCoarse();
    else if (this.coarse && this.filled < this.canvas.height && now() > this.restsUntil) this.drawStrip();
  }

  get isDone() {
    return !this.stale && !this.job && this.filled >= this.canvas.height;
  }

  fitCanvas() {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    const shrink = Math.min(1, Math.sqrt(MAX_PIXELS / Math.max(1, box.width * box.height * ratio * ratio)));
    const [width, height] = [box.width, box.height].map((side) => Math.max(1, Math.round(side * ratio * shrink)));
    if (this.canvas.width === width && this.canvas.height === height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.touch();
  }

  /** Whether the job is done; then its time has steered the next one and it is on the screen. */
  finished() {
    const { gl } = this.graphics, { job } = this;
    if (gl.getSyncParameter(job.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(job.fence);
    this.job = null;
    job.done(now() - job.began);
    return true;
  }

  start(draw, done) {
    const { gl } = this.graphics, began = now();
    draw();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.job = { fence, began, done };
  }

  drawCoarse() {
    const { width, height } = this.canvas, share = Math.min(1, Math.sqrt(this.movingPixels / (width * height)));
    this.coarse = this.sized(this.coarse, Math.max(1, Math.round(width * share)), Math.max(1, Math.round(height * share)));
    const target = this.coarse, request = { ...this.request(), opacityStep: MOVING_OPACITY_STEP };
    this.stale = false;
    this.shownRequest = request;
    this.start(() => this.graphics.draw(target, request), (ms) => {
      this.coarseMs = ms;
      this.movingPixels = clamp(target.width * target.height * clamp(MOVING_MS / ms, 1 / MAX_GROWTH, MAX_GROWTH), MIN_PIXELS, width * height);
      this.show(target);
    });
  }

  drawStrip() {
    const { width, height } = this.canvas;
    if (!this.filled && !this.keeps) {
      this.fine = this.sized(this.fine, width, height);
      this.graphics.copy(this.coarse, this.fine);
    }
    const from = this.filled, to = Math.min(height, from + Math.max(1, Math.floor(this.stripPixels / width)));
    const request = { ...this.request(), opacityStep: OPACITY_STEP };
    // From the top, where eyes begin; rows are counted from the bottom.
    this.start(() => this.graphics.draw(this.fine, request, height - to, height - from), (ms) => {
      this.stripPixels = Math.max(width, width * (to - from) * clamp(STRIP_MS / ms, 1 / MAX_GROWTH, MAX_GROWTH));
      if (this.stale) return;
      this.restsUntil = now() + ms * (1 / this.stripFraction - 1);
      this.filled = to;
      this.show(this.fine);
    });
  }

  sized(target, width, height) {
    if (target && target.width === width && target.height === height) return target;
    if (target) this.graphics.free(target);
    return this.graphics.target(width, height);
  }

  show(target) {
    this.graphics.present(target);
    this.over(this.shownRequest, target);
    this.presented = target;
  }

  /** What lies over the picture has changed, the picture has not. */
  showAgain() {
    if (this.presented && !this.stale && !this.job) this.show(this.presented);
  }

  /** A whole picture of any size, rows from the top, as RGBA bytes; drawn in strips, so that no driver takes it for hung. */
  async picture(width, height, changes = {}) {
    const { graphics } = this, target = graphics.target(width, height);
    const request = { ...this.request(), opacityStep: OPACITY_STEP, ...changes };
    const rows = Math.max(1, Math.floor(MIN_PIXELS / width));
    for (let from = 0; from < height; from += rows) {
      graphics.draw(target, request, from, Math.min(height, from + rows));
      await this.idle();
    }
    const bytes = graphics.read(target);
    graphics.free(target);
    const turned = new Uint8ClampedArray(bytes.length);
    for (let row = 0; row < height; ++row) turned.set(bytes.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    return turned;
  }

  async idle() {
    const { gl } = this.graphics, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
      if (gl.isContextLost()) throw new Error("the graphics context was lost");
      await new Promise((resume) => setTimeout(resume, 4));
    }
    gl.deleteSync(fence);
  }

  /** The distance along the ray of a pixel of the canvas at which half of the light is stopped; null in empty space. */
  distanceAt(x, y) {
    const { width, height } = this.canvas, target = this.graphics.target(1, 1), lens = fitted(this.request().lens, width, height);
    const pixel = { width: 1, height: 1, fx: lens.fx, fy: lens.fy, cx: lens.cx - x + 0.5, cy: lens.cy - y + 0.5 };
    this.graphics.draw(target, { ...this.request(), lens: pixel, opacityStep: OPACITY_STEP });
    const distance = this.graphics.readDistance(target);
    this.graphics.free(target);
    return Number.isFinite(distance) ? distance : null;
  }
}
