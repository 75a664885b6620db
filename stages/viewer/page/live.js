// A running training: what its server (pipeline/view) tells, and field after field as it comes.

const FIRST_POLL_MS = 300; // before the first field is there
const POLL_MS = 1000;
const SLOW_POLL_MS = 3000; // where nothing changes: less than OPEN_SECONDS of the server
const PATIENCE_MS = 15_000; // fields may come faster than a picture fills in: it is finished first, unless that takes longer
const STRIP_FRACTION = 0.1; // of the time in which pixels fill in: without a graphics chip the training and the page share the cores
const NO_FIELD = "No training is running, and there is no field yet. pipeline status says how far the run came; pipeline resume continues it.";
const SVG = "http://www.w3.org/2000/svg";

class Follower {
  constructor() {
    this.shown = null; // the name of the field that is drawn
    this.key = null; // of the training that is followed
    byId("finish").addEventListener("click", () => this.finish());
    this.poll();
  }

  /** Asks how the training stands, and again later: after the end, too, for another may follow. */
  async poll() {
    let state = null;
    try {
      state = await this.answer("state", "json");
      if (!state) return;
      if (this.key && state.key && state.key !== this.key) return location.reload(); // its scene may be another
      this.key = state.key ?? this.key;
      this.state = state;
      this.tell(state);
      await this.follow(state.field);
    } finally {
      const isDone = state?.phase === "finished" && (this.cannot || this.shown === state.field);
      const isWaiting = state?.phase === "training" && !this.shown && !this.cannot;
      setTimeout(() => this.poll(), isDone || !state ? SLOW_POLL_MS : isWaiting ? FIRST_POLL_MS : POLL_MS);
    }
  }

  /** What the server answers, as "json" or "arrayBuffer"; null where that is nothing, which is then said. */
  async answer(address, kind, options) {
    try {
      const response = await fetch(address, options);
      if (response.status === 200) return await response[kind]();
      if (!response.ok) this.fault(`The server answers ${response.status}; its terminal says why.`);
    } catch (error) {
      const ended = this.shown ? "The server has ended; what it showed last stays." : "The server has ended.";
      this.fault(error instanceof TypeError ? ended : `The server's answer cannot be read: ${error.message}`);
    }
    return null;
  }

  fault(text) {
    byId("live-phase").textContent = text;
    byId("finish").disabled = true;
  }

  /** Draws the field of that name, if it is another than the one that is drawn. */
  async follow(name) {
    if (!name || name === this.shown || this.cannot) return;
    const filling = window.viewer && !window.viewer.renderer.isDone;
    if (filling && this.state.phase === "training" && performance.now() - this.shownSince < PATIENCE_MS) return;
    const field = await this.answer(`field/${name}`, "arrayBuffer");
    if (!field) return; // the training has gone on: the next answer names a newer one
    const scene = window.viewer ? null : await this.answer("scene", "arrayBuffer");
    if (!scene && !window.viewer) return;
    try {
      if (await this.draw(contentsOf(field), scene && contentsOf(scene))) [this.shown, this.shownSince] = [name, performance.now()];
    } catch (error) {
      this.cannot = true;
      sayWhyNot(error);
      console.error(error);
    }
  }

  /** Whether the page can draw such a field. */
  async draw(field, scene) {
    if (!field.field) {
      this.cannot = true;
      say("This field cannot be drawn while it trains: the page draws hash-grid fields. Its figures are in the menu.");
      return false;
    }
    const section = (part) => field.section(part) ?? scene.section(part);
    if (!window.viewer) {
      const metres = this.state.metres_per_unit, [row] = scene.scene.sfm_from_scene; // a rotation times a scale
      scene.scene.metres_per_unit = metres && metres * norm(row.slice(0, 3));
      await open({ ...scene, field: field.field, section });
    }
    window.viewer.renderer.stripFraction = this.state.phase === "training" ? STRIP_FRACTION : 1;
    window.viewer.replace(field);
    return true;
  }

  async finish() {
    byId("finish").disabled = true;
    this.asked = Boolean((await this.answer("finish", "json", { method: "POST" }))?.asked);
  }

  /** Brings the figures in line with what the server told. */
  tell({ phase, step, total_steps: total, progress, seconds_left: left, rays_per_second: rays, train_psnr: train, curve, finishing }) {
    const at = step === undefined ? "" : ` · step ${step.toLocaleString("en")} of ${total.toLocaleString("en")}`;
    byId("live-phase").textContent = {
      waiting: "The training has not begun.",
      training: finishing ? `Finishing${at}` : `Training${at}`,
      stopped: at ? `The training was stopped${at}. pipeline resume continues it.` : NO_FIELD,
      finished: `Finished${at}`,
    }[phase];
    const figures = [
      phase === "training" && left !== undefined && `${lasting(left)} left`,
      phase === "training" && rays !== undefined && `${Math.round(rays / 1000)} k rays/s`,
      train !== undefined && `train ${train.toFixed(1)} dB`,
    ];
    byId("live-figures").textContent = figures.filter(Boolean).join(" · ");
    byId("live-progress").value = progress ?? (this.shown ? 1 : 0); // between the last step and the finished folder: 1
    byId("finish").hidden = phase !== "training" || step === undefined;
    if (phase !== "training") this.asked = false;
    byId("finish").disabled = Boolean(finishing || this.asked);
    byId("finish").textContent = finishing ? "Finishing …" : this.asked ? "Asked to finish …" : "Finish now";
    drawCurve(byId("live-curve"), curve ?? []);
    if (!this.shown && !this.cannot) say({ waiting: "Waiting for the training to begin …", training: "Waiting for the first field …", stopped: NO_FIELD, finished: "Unpacking the field …" }[phase]);
  }
}

const lasting = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);

/** PSNR over training seconds: of test pixels where there are any, else of training batches. */
function drawCurve(svg, curve) {
  const tested = curve.some(([, test]) => test !== null), [width, height, left, bottom] = [250, 100, 26, 14];
  const points = curve.map(([seconds, test, train]) => [seconds, tested ? test : train]).filter(([, psnr]) => psnr !== null);
  svg.replaceChildren();
  svg.style.display = points.length ? "" : "none";
  if (!points.length) return;
  const low = Math.floor(Math.min(...points.map(([, psnr]) => psnr))), high = Math.ceil(Math.max(...points.map(([, psnr]) => psnr)) + 1e-6);
  const last = points.at(-1), x = (seconds) => left + ((width - left - 4) * seconds) / last[0];
  const y = (psnr) => 4 + (height - bottom - 4) * (1 - (psnr - low) / Math.max(1, high - low));
  const draw = (name, settings, text = "") => {
    svg.append(Object.assign(document.createElementNS(SVG, name), { textContent: text }));
    for (const [key, value] of Object.entries(settings)) svg.lastChild.setAttribute(key, value);
  };
  for (const psnr of [low, high]) {
    draw("line", { x1: left, x2: width, y1: y(psnr), y2: y(psnr), class: "grid" });
    draw("text", { x: left - 4, y: y(psnr) + 4, "text-anchor": "end" }, String(psnr));
  }
  draw("text", { x: width, y: height - 1, "text-anchor": "end" }, lasting(last[0]));
  draw("polyline", { points: points.map(([seconds, psnr]) => `${x(seconds)},${y(psnr)}`).join(" "), class: "curve" });
  draw("circle", { cx: x(last[0]), cy: y(last[1]), r: 3, class: "end" });
  svg.setAttribute("aria-label", `PSNR of ${tested ? "test pixels" : "training batches"}: ${last[1].toFixed(1)} dB after ${lasting(last[0])}`);
  draw("text", { x: left + 4, y: 12, class: "now" }, `${last[1].toFixed(1)} dB on ${tested ? "test pixels" : "training batches"}`);
}

function follow() {
  const why = missing();
  if (why) say(why);
  window.follower = new Follower();
  if (why) window.follower.cannot = true;
}
