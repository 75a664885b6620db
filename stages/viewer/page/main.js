// The viewer: what is shown, and how its parts hang together. Its public functions are what tests call, too.

const SAVE_LINK_MS = 400; // without a move until the address holds the view
const CROSS = 0.012; // half the size of a measured point's cross, of its distance
const BACKGROUNDS = { white: [1, 1, 1], black: [0, 0, 0] };

class Viewer {
  constructor(canvas, contents) {
    Object.assign(this, { canvas, contents, view: "colour", background: "trained", stops: 0, photo: null, nextPhoto: null, crop: null });
    Object.assign(this, { measured: [], isMeasuring: false, path: new CameraPath(), lens: lensOf(contents.scene.lens) });
    this.training = contents.views.filter((view) => view.split === "train");
    this.navigation = new Navigation(canvas, contents.scene.up, (kind) => this.moved(kind), (x, y) => this.clicked(x, y));
    this.navigation.pose = this.home();
    this.overlay = new Overlay(contents);
    this.renderer = new Renderer(canvas, contents, () => this.request(), (request, target) => this.drawOver(request, target));
    this.overlay.restore(this.renderer.graphics);
    this.homeDistance = this.navigation.distance = this.distanceAhead(); // also where a link leads elsewhere
    this.readLink();
    this.panels = new Panels(this);
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.panels.say("The graphics chip was taken away; waiting for it …");
    });
    canvas.addEventListener("webglcontextrestored", () => {
      this.renderer.restore();
      this.overlay.restore(this.renderer.graphics);
      this.panels.say("");
    });
    canvas.addEventListener("dblclick", (event) => this.orbitAround(event));
    window.addEventListener("hashchange", () => this.readLink());
    requestAnimationFrame((time) => this.frame(time, time));
  }

  /** A training camera: of those that face one way the one in the middle, else the one of median elevation. */
  home() {
    const { scene } = this.contents, poses = this.training.map((view) => view.pose);
    const middle = scaled(poses.reduce((sum, pose) => add(sum, pose.centre), [0, 0, 0]), 1 / poses.length);
    const aside = (pose) => norm(subtract(pose.centre, middle)), elevation = (pose) => dot(forward(pose), scene.up);
    const by = scene.forward_facing ? aside : elevation;
    const ordered = poses.sort((a, b) => by(a) - by(b));
    return ordered[scene.forward_facing ? 0 : ordered.length >> 1];
  }

  distanceAhead() {
    const lens = fitted(this.lens, this.canvas.width, this.canvas.height);
    return this.renderer.distanceAt(lens.width / 2, lens.height / 2) ?? Math.max(0.5, norm(this.navigation.pose.centre));
  }

  request() {
    const { field, scene, views } = this.contents, { pose } = this.navigation;
    const photo = this.photo === null ? null : views[this.photo], shown = photo ?? field;
    return {
      pose,
      lens: this.lens,
      view: this.view,
      nearFar: photo ? photo.nearFar : nearFarBetween(pose, this.training, scene.bounded),
      background: BACKGROUNDS[this.background] ?? field.background,
      logGain: shown.log_gain.map((gain) => gain + this.stops * Math.LN2),
      falloff: shown.falloff,
      crop: this.crop,
    };
  }

  frame(time, before) {
    this.navigation.frame(Math.min(0.1, (time - before) / 1000));
    this.renderer.frame();
    if (this.moveTime && now() - this.moveTime > SAVE_LINK_MS) this.writeLink();
    requestAnimationFrame((next) => this.frame(next, time));
  }

  /** Another field of the same scene, and the exposures that go with it. */
  replace({ field, gains, section }) {
    const { contents } = this, first = (this.firstSection ??= contents.section); // of its parts, not of the last field's
    contents.views.forEach((view, index) => Object.assign(view, gains[index]));
    Object.assign(contents, { field, section: (name) => section(name) ?? first(name) });
    this.renderer.load(contents);
  }

  /** Some part of what is shown was changed. */
  changed() {
    this.renderer.touch();
    this.panels?.update();
  }

  moved(kind) {
    if (!kind) this.leave();
    this.moveTime = now();
    this.renderer?.touch();
    this.panels?.update();
  }

  /** The view goes elsewhere: no photo fits it any more, and no path plays on. */
  leave() {
    Object.assign(this, { photo: null, nextPhoto: null, playing: null });
  }

  drawOver(request, target) {
    const lines = this.crop ? boxLines(this.crop, COLOURS.crop) : [];
    const crossSize = (point) => CROSS * norm(subtract(point, request.pose.centre));
    const above = this.measured.flatMap((point) => crossLines(point, crossSize(point), COLOURS.measure));
    if (this.measured.length === 2) above.push([...this.measured, COLOURS.measure]);
    const { keys } = this.path;
    keys.slice(1).forEach((key, i) => lines.push([keys[i].centre, key.centre, COLOURS.path]));
    this.overlay.draw(request, target, { lines, above }, this.photo);
    this.panels?.place(request);
  }

  // --- photos

  async showPhoto(index) {
    const view = this.contents.views[index];
    this.lens = view.lens;
    this.leave();
    this.nextPhoto = index;
    this.changed(); // named at once, not by the first picture of the flight
    await this.navigation.flyTo(view.pose);
    if (this.nextPhoto !== index) return; // it was left on the way
    [this.photo, this.nextPhoto] = [index, null];
    this.changed();
  }

  leavePhoto() {
    this.photo = this.nextPhoto = null;
    this.changed();
  }

  reset() {
    this.lens = lensOf(this.contents.scene.lens);
    this.leave();
    return this.navigation.flyTo(this.home(), this.homeDistance);
  }

  level() {
    this.leave();
    return this.navigation.level();
  }

  // --- clicks: cameras, points to measure, points to orbit around

  clicked(x, y) {
    if (this.isMeasuring) return this.measure(x, y);
    if (!this.overlay.layers.cameras) return;
    const lens = fitted(this.lens, this.canvas.width, this.canvas.height), reach = 24 * (window.devicePixelRatio || 1);
    const { pose } = this.navigation;
    const near = this.contents.views.flatMap((view, index) =>
      [view.pose.centre, ...this.overlay.frustum(view)].map((point) => ({ index, point, ...projected(pose, lens, point) })));
    const within = near.map((each) => ({ ...each, away: Math.hypot(each.x - x, each.y - y) }))
      .filter((each) => each.depth > 0 && each.away < reach)
      .sort((a, b) => a.away - b.away);
    const seen = within.find((each) => !this.isHidden(each));
    if (seen) return this.showPhoto(seen.index);
  }

  /** Whether any camera stands within the view; what hides it aside. */
  seesCameras() {
    const { width, height } = this.canvas, lens = fitted(this.lens, width, height);
    const isWithin = ({ x, y, depth }) => depth > 0 && x > 0 && x < width && y > 0 && y < height;
    return this.contents.views.some((view) => isWithin(projected(this.navigation.pose, lens, view.pose.centre)));
  }

  /** Whether the field's surface lies in front of a point that is seen at pixel (x, y), as in overlay.glsl. */
  isHidden({ point, x, y }) {
    const surface = this.renderer.distanceAt(x, y) ?? Infinity;
    return norm(subtract(point, this.navigation.pose.centre)) > surface * (1 + RELATIVE_MARGIN) + MARGIN;
  }

  /** The point of the scene that a pixel of the canvas shows; null in empty space. */
  pointAt(x, y) {
    const distance = this.renderer.distanceAt(x, y), lens = fitted(this.lens, this.canvas.width, this.canvas.height);
    if (distance === null) return null;
    const { pose } = this.navigation;
    return add(pose.centre, scaled(pixelDirection(pose, lens, x, y), distance));
  }

  measure(x, y) {
    const point = this.pointAt(x, y);
    if (!point) return this.panels.say("There is nothing at this place.", true);
    this.measured = this.measured.length === 1 ? [this.measured[0], point] : [point];
    this.changed();
  }

  /** {value, unit} between the two measured points. */
  distance() {
    if (this.measured.length < 2) return null;
    const length = norm(subtract(...this.measured)), metres = this.contents.scene.metres_per_unit;
    return metres ? { value: length * metres, unit: "m" } : { value: length, unit: "scene units" };
  }

  orbitAround(event) {
    const box = this.canvas.getBoundingClientRect(), ratio = this.canvas.width / box.width;
    const point = this.pointAt((event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio);
    if (!point || this.isMeasuring) return;
    const { pose } = this.navigation, depth = dot(subtract(point, pose.centre), forward(pose));
    this.leave();
    const aside = subtract(subtract(point, pose.centre), scaled(forward(pose), depth));
    this.navigation.flyTo({ ...pose, centre: add(pose.centre, aside) }, depth);
  }

  // --- camera path

  pathJson(secondsPerKey) {
    return this.path.json(this.lens, this.contents.scene.sfm_from_scene, secondsPerKey);
  }

  async play(secondsPerKey) {
    const frames = this.path.frames(secondsPerKey), began = now(), playing = {}, isOn = () => this.playing === playing;
    this.leave();
    [this.playing, this.navigation.flight] = [playing, null];
    for (let index = 0; isOn() && index < frames.length; index = Math.floor(((now() - began) / 1000) * FPS)) {
      this.navigation.pose = frames[index];
      this.moved("playing");
      await new Promise(requestAnimationFrame);
    }
    if (isOn() && frames.length) this.navigation.moveTo(frames[frames.length - 1]);
  }

  // --- the address holds the view

  writeLink() {
    this.moveTime = null;
    const { pose, distance } = this.navigation, digits = (values) => values.map((x) => x.toPrecision(7)).join(",");
    const link = `#c=${digits(pose.centre)}&q=${digits(quaternion(pose.rotation))}&d=${digits([distance])}&v=${this.view}`;
    try {
      history.replaceState(null, "", link);
    } catch {
      // A browser that gives files no address has no link; everything else works.
    }
  }

  readLink() {
    const values = new URLSearchParams(location.hash.slice(1)), numbers = (name) => (values.get(name) ?? "").split(",").map(parseFloat);
    const [centre, turn, [distance]] = [numbers("c"), numbers("q"), numbers("d")];
    const isWhole = centre.length === 3 && turn.length === 4 && [...centre, ...turn, distance].every(Number.isFinite);
    if (!isWhole || !(norm(turn) > 0) || !(distance > 0)) return;
    this.navigation.distance = distance;
    const choices = [...document.getElementsByName("view")].map((input) => input.value);
    if (choices.includes(values.get("v"))) this.view = values.get("v");
    this.navigation.moveTo({ centre, rotation: rotationOf(unit(turn)) });
  }
}

const say = (text) => (byId("message").textContent = text);

/** Why this browser cannot show a scene; null where it can. */
function missing() {
  if (!window.WebGL2RenderingContext) return "This browser has no WebGL 2, with which the scene is drawn. Any current Chrome, Firefox or Safari has it.";
  if (!window.DecompressionStream) return "This browser is too old to unpack the scene. Chrome 80, Firefox 113, Safari 16.4 and later can.";
  return null;
}

/** Draws the contents from now on. */
async function open(contents) {
  say("Preparing the graphics chip …");
  await new Promise((resume) => setTimeout(resume, 30));
  window.viewer = new Viewer(byId("canvas"), contents);
  say("");
}

function sayWhyNot(error) {
  say(error.message === "no WebGL2"
    ? "WebGL 2 is turned off in this browser or not supported by its graphics driver; the scene is drawn with it."
    : `The scene cannot be drawn here: ${error.message}`);
}

async function start() {
  const why = missing();
  if (why) return say(why);
  try {
    await open(await unpacked(byId("payload").textContent));
  } catch (error) {
    sayWhyNot(error);
    throw error;
  }
}
