// The controls beside the picture. Text from files goes in as text, never as HTML.

const byId = (id) => document.getElementById(id);
const SAID_MS = 2500;
const ROOMY_PX = 900; // on a narrower screen the menu would hide the scene

class Panels {
  constructor(viewer) {
    this.viewer = viewer;
    const { field, exposure, scene } = viewer.contents;
    byId("exposure-row").hidden = !exposure;
    byId("background-row").hidden = field.background_levels.length > 0 || !scene.has_alpha;
    this.menu();
    this.shown();
    this.layers();
    this.photos();
    this.measuring();
    this.cropping();
    this.path();
    this.about();
    document.addEventListener("keydown", (event) => this.keyed(event));
    this.update();
  }

  on(id, name, act) {
    byId(id).addEventListener(name, act);
  }

  menu() {
    const panel = byId("panel"), toggle = (open) => {
      panel.hidden = !open;
      document.body.classList.toggle("with-panel", open);
      byId("menu").setAttribute("aria-expanded", String(open));
    };
    this.on("menu", "click", () => toggle(panel.hidden));
    this.isRoomy = () => window.innerWidth > ROOMY_PX;
    toggle(this.isRoomy());
    this.on("views", "change", () => this.isRoomy() || toggle(false));
  }

  shown() {
    const { viewer } = this;
    for (const input of document.getElementsByName("view")) {
      input.addEventListener("change", () => {
        viewer.view = input.value;
        viewer.moved("view");
      });
    }
    this.on("background", "change", (event) => {
      viewer.background = event.target.value;
      viewer.changed();
    });
    this.on("exposure", "input", (event) => {
      viewer.stops = Number(event.target.value);
      byId("exposure-value").textContent = `${viewer.stops > 0 ? "+" : ""}${viewer.stops} EV`;
      viewer.changed();
    });
    this.on("reset", "click", () => viewer.reset());
    this.on("level", "click", () => viewer.level());
    this.on("screenshot", "click", () => this.screenshot());
    this.on("link", "click", async () => {
      viewer.writeLink();
      const copied = navigator.clipboard?.writeText(location.href) ?? Promise.reject();
      await copied.then(() => this.say("Copied.", true), () => this.say("The address bar has the link.", true));
    });
  }

  layers() {
    const { viewer } = this;
    for (const name of Object.keys(viewer.overlay.layers)) {
      this.on(`layer-${name}`, "change", (event) => {
        viewer.overlay.layers[name] = event.target.checked;
        byId("clay-row").hidden = !viewer.overlay.layers.mesh;
        viewer.renderer.showAgain();
        if (name === "cameras" && event.target.checked && !viewer.seesCameras()) this.say("The cameras stand outside of the view. Zoom out to see them.", true);
      });
    }
    byId("layer-mesh").disabled = !viewer.contents.mesh;
    this.on("clay", "change", (event) => {
      viewer.overlay.isClay = event.target.checked;
      viewer.renderer.showAgain();
    });
  }

  photos() {
    const { viewer } = this, { views, section } = viewer.contents, list = byId("views");
    for (const split of ["train", "test"]) {
      const group = document.createElement("optgroup");
      group.label = split === "test" ? "held out" : "trained on";
      views.forEach((view, index) => {
        if ((view.split === "test") !== (split === "test")) return;
        const option = document.createElement("option");
        [option.value, option.textContent] = [index, view.name];
        group.append(option);
      });
      if (group.children.length) list.append(group);
    }
    list.addEventListener("change", () => list.value !== "" && viewer.showPhoto(Number(list.value)));
    byId("photos-note").textContent = section("photo0") ? "" : byId("payload") ? "This file contains no photos." : "Photos are in the page of the finished run.";
    const step = (by) => viewer.showPhoto(((viewer.photo ?? viewer.nextPhoto) + by + views.length) % views.length);
    this.on("photo-before", "click", () => step(-1));
    this.on("photo-after", "click", () => step(1));
    this.on("photo-close", "click", () => viewer.leavePhoto());
    this.on("photo-share", "input", () => this.update());
  }

  measuring() {
    const { viewer } = this;
    this.on("measure", "toggle", (event) => {
      viewer.isMeasuring = event.target.open;
      viewer.canvas.classList.toggle("measuring", viewer.isMeasuring);
    });
    this.on("measure-clear", "click", () => {
      viewer.measured = [];
      viewer.changed();
    });
  }

  cropping() {
    const { viewer } = this, extent = viewer.contents.scene.bounded ? 0.9 : 2, bounds = {};
    const apply = () => {
      const side = (name) => [0, 1, 2].map((axis) => Number(bounds[`${axis}${name}`].value));
      viewer.crop = byId("crop-on").checked ? { low: side("low"), high: side("high") } : null;
      viewer.changed();
    };
    ["x", "y", "z"].forEach((axis, index) => {
      for (const [name, value] of [["low", -extent], ["high", extent]]) {
        const label = document.createElement("label"), input = document.createElement("input");
        Object.assign(input, { type: "range", min: -extent, max: extent, step: extent / 100, value });
        input.addEventListener("input", () => {
          const other = bounds[`${index}${name === "low" ? "high" : "low"}`];
          const gap = extent / 50, limit = Number(other.value);
          input.value = name === "low" ? Math.min(input.value, limit - gap) : Math.max(input.value, limit + gap);
          byId("crop-on").checked = true;
          apply();
        });
        bounds[`${index}${name}`] = input;
        label.append(`${axis} ${name === "low" ? "from" : "to"} `, input);
        byId("crop-sliders").append(label);
      }
    });
    this.on("crop-on", "change", apply);
  }

  path() {
    const { viewer } = this, seconds = () => clamp(Number(byId("path-seconds").value) || 2, 0.1, 60);
    this.on("path-add", "click", () => {
      viewer.path.keys.push(viewer.navigation.pose);
      viewer.changed();
    });
    this.on("path-remove", "click", () => {
      viewer.path.keys.pop();
      viewer.changed();
    });
    this.on("path-play", "click", () => viewer.play(seconds()));
    this.on("path-save", "click", () => {
      const text = JSON.stringify(viewer.pathJson(seconds()), null, 1);
      save(new Blob([text], { type: "application/json" }), "path.json");
    });
  }

  about() {
    const { field, comparison, appearance, scene, mesh, sections } = this.viewer.contents, list = byId("about");
    const rows = field.levels.reduce((sum, level) => sum + level.rows, 0);
    const bytes = byId("payload")?.textContent.length;
    const facts = {
      Field: `${field.levels.length} hash grids, ${(rows / 1e6).toFixed(2)} million rows of 4 features, up to ${field.levels.at(-1).resolution} cells a side`,
      Space: { box: "a box", contraction: "all of space, contracted", ndc: "normalised device coordinates" }[field.space.kind],
      Numbers: `${field.bits} bits each` + (bytes ? `; ${(bytes / (4 * rows)).toFixed(2)} bytes of this file per number` : ""),
      ...(comparison && { "Loss by packing": `${(comparison.trained_db - comparison.packed_db).toFixed(3)} dB: ${comparison.packed_db.toFixed(2)} instead of `
        + `${comparison.trained_db.toFixed(2)} dB on ${comparison.views} reduced photos` }),
      "Work of a pixel": `${field.levels.length * 8} table reads at each sample on its ray`,
      Appearance: appearance ?? "as the photos show it",
      Scale: scene.metres_per_unit ? `a scene unit is ${scene.metres_per_unit.toPrecision(4)} m` : "unknown: lengths are in scene units",
      Photos: sections.photo0 ? `${this.viewer.contents.views.length} small copies are in this file` : "none are in this file",
      Mesh: mesh ? `${mesh.faces.toLocaleString("en")} faces` : "none is in this file",
      Network: byId("watch") ? "this page asks the server on your own machine, and nobody else" : bytes ? "this file never uses any" : "this page asks the server on your own machine, and nobody else",
    };
    for (const [name, text] of Object.entries(facts)) {
      for (const [tag, content] of [["dt", name], ["dd", text]]) {
        list.append(Object.assign(document.createElement(tag), { textContent: content }));
      }
    }
  }

  keyed(event) {
    const key = event.key.toLowerCase(), view = Object.keys(VIEWS)[Number(key) - 1];
    if (key === "escape") this.viewer.playing = null;
    if (key === "escape" && !byId("compare").hidden) this.viewer.leavePhoto();
    if (!isForScene(event)) return;
    if (key >= "1" && key <= "4" && key.length === 1) document.querySelector(`input[name="view"][value="${view}"]`).click();
    if (key === "c") byId("layer-cameras").click();
    if (key === "p") byId("layer-points").click();
    if (key === "m") byId("layer-mesh").click();
    if (key === "r") this.viewer.reset();
  }

  /** A line over the picture, for a moment or until the next. */
  say(text, briefly = false) {
    byId("message").textContent = text;
    clearTimeout(this.saying);
    if (briefly) this.saying = setTimeout(() => this.say(""), SAID_MS);
  }

  /** Brings everything in line with the viewer. */
  update() {
    const { viewer } = this, { photo } = viewer, chosen = photo ?? viewer.nextPhoto, distance = viewer.distance();
    document.querySelector(`input[name="view"][value="${viewer.view}"]`).checked = true;
    byId("distance").textContent = distance ? `${distance.value.toPrecision(4)} ${distance.unit}` : viewer.measured.length ? "one point" : "–";
    const count = viewer.path.keys.length;
    byId("path-count").textContent = count ? `${count} key-frame${count > 1 ? "s" : ""}` : "No key-frames";
    byId("path-save").disabled = byId("path-play").disabled = count < 2;
    byId("path-remove").disabled = count < 1;
    byId("compare").hidden = chosen === null; // on the way there it stays, with the focus that it may have
    byId("views").value = chosen ?? "";
    const picture = photo === null ? null : viewer.contents.section(`photo${photo}`);
    byId("photo").hidden = !picture;
    if (chosen === null) return;
    byId("photo-name").textContent = viewer.contents.views[chosen].name;
    byId("photo-share").disabled = !viewer.contents.section(`photo${chosen}`);
    if (picture) this.showPicture(photo, picture);
  }

  showPicture(photo, bytes) {
    const image = byId("photo-image"), { canvas, lens } = this.viewer;
    if (this.pictured !== photo) {
      URL.revokeObjectURL(image.src);
      image.src = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
      this.pictured = photo;
    }
    const box = canvas.getBoundingClientRect(), { scale } = fitted(lens, box.width, box.height);
    const [width, height] = [lens.width * scale, lens.height * scale];
    Object.assign(byId("photo").style, {
      left: `${(box.width - width) / 2}px`, top: `${(box.height - height) / 2}px`, width: `${width}px`, height: `${height}px`,
      clipPath: `inset(0 ${100 - byId("photo-share").value}% 0 0)`,
    });
  }

  /** Puts the label of the measured distance where its line is. */
  place(request) {
    const { viewer } = this, distance = viewer.distance(), label = byId("label");
    if (viewer.photo !== null) this.update();
    label.hidden = !distance;
    if (!distance) return;
    const middle = scaled(add(...viewer.measured), 0.5), box = viewer.canvas.getBoundingClientRect();
    const at = projected(request.pose, fitted(request.lens, box.width, box.height), middle);
    label.hidden = at.depth <= 0;
    label.textContent = `${distance.value.toPrecision(4)} ${distance.unit}`;
    Object.assign(label.style, { left: `${at.x}px`, top: `${at.y}px` });
  }

  /** What the canvas shows, layers included, once all pixels are there. */
  async screenshot() {
    const { canvas, renderer } = this.viewer;
    this.say("Drawing all pixels …");
    while (!renderer.isDone) await new Promise(requestAnimationFrame);
    this.say("");
    renderer.showAgain(); // browsers keep what is drawn only until their own next frame
    canvas.toBlob((blob) => save(blob, "picture.png"));
  }
}

/** Hands a file to the user. */
function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
