// A training at work: what its server (pipeline/view) tells, and field after field as it comes.

const ASK_MS = 1000;
const SHARE = 0.1; // of the time in which pixels fill in: without a graphics chip the training and the page share the cores
const SVG = "http://www.w3.org/2000/svg";

class Follower {
  constructor() {
    this.shown = null; // the name of the field that is drawn
    byId("finish").addEventListener("click", () => this.finish());
    this.ask();
  }

  /** Asks how the training stands, and once more a second later. */
  async ask() {
    try {
      const response = await fetch("state");
      if (!response.ok) throw new Error(`the server answers ${response.status}`);
      this.state = await response.json();
      this.tell(this.state);
      await this.follow(this.state.field);
    } catch (error) {
      byId("live-phase").textContent = this.shown ? "The server has ended; what it showed last stays." : "The server has ended.";
      byId("finish").disabled = true;
      if (!(error instanceof TypeError)) console.error(error); // fetch throws that one where nobody answers
    }
    if (this.state?.phase !== "finished" || this.shown !== this.state.field) setTimeout(() => this.ask(), ASK_MS);
  }

  /** Draws the field of that name, if it is another than the one that is drawn. */
  async follow(name) {
    if (!name || name === this.shown || this.cannot) return;
    const field = await this.fetched(`field/${name}`);
    if (!field) return; // the training has gone on: the next answer names a newer one
    if (!field.field) return this.fail("This field cannot be drawn while it trains: the page draws hash-grid fields. Its figures are in the menu.");
    if (!window.viewer) {
      const scene = await this.fetched("scene");
      if (!scene) return;
      const { field: settings, section } = field;
      const contents = { ...scene, field: settings, section: (part) => section(part) ?? scene.section(part) };
      try {
        await open(contents);
      } catch (error) {
        this.cannot = true;
        sayWhyNot(error);
      }
    }
    window.viewer.renderer.share = this.state.phase === "training" ? SHARE : 1;
    window.viewer.replace(field);
    this.shown = name;
  }

  fail(text) {
    this.cannot = true;
    say(text);
  }

  async fetched(what) {
    const response = await fetch(what);
    return response.status === 200 ? contentsOf(await response.arrayBuffer()) : null;
  }

  async finish() {
    byId("finish").disabled = true;
    await fetch("finish", { method: "POST" });
    this.asked = true;
  }

  /** Brings the figures in line with what the server told. */
  tell({ phase, step, total_steps: total, progress, seconds_left: left, rays_per_second: rays, train_psnr: train, curve, finishing }) {
    const at = step === undefined ? "" : ` · step ${step.toLocaleString("en")} of ${total.toLocaleString("en")}`;
    byId("live-phase").textContent = {
      waiting: "The training has not begun.",
      training: finishing ? `Finishing${at}` : `Training${at}`,
      stopped: `No training is at work${at}. pipeline resume continues it.`,
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
    byId("finish").disabled = Boolean(finishing || this.asked);
    byId("finish").textContent = finishing ? "Finishing …" : this.asked ? "Asked to finish …" : "Finish now";
    drawCurve(byId("live-curve"), curve ?? []);
    if (!this.shown && !this.cannot) say({ waiting: "Waiting for the training to begin …", training: "Waiting for the first field …", stopped: "There is no field to show yet.", finished: "Unpacking the field …" }[phase]);
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
