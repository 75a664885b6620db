// What lies over the picture: cameras, sparse points, the crop box, axes, the measured line. Nothing hides it.

const COLOURS = {
  train: [0.35, 0.65, 1], validation: [0.35, 0.65, 1], test: [1, 0.65, 0.2], chosen: [1, 1, 1],
  crop: [1, 0.9, 0.3], measure: [1, 0.25, 0.55], path: [0.4, 0.95, 0.5],
};
const AXES = [[[1, 0, 0], [0.95, 0.3, 0.3]], [[0, 1, 0], [0.35, 0.8, 0.35]], [[0, 0, 1], [0.4, 0.55, 1]]];
const OVERLAY_NEAR = 0.01; // scene units

class Overlay {
  constructor(contents) {
    Object.assign(this, { contents, layers: { cameras: false, points: false, axes: false } });
    const centres = contents.views.map((view) => view.pose.centre);
    const spread = Math.max(...[0, 1, 2].map((axis) => Math.max(...centres.map((c) => c[axis])) - Math.min(...centres.map((c) => c[axis]))));
    this.frustumDepth = clamp(0.04 * spread, 0.01, 0.2);
  }

  restore(graphics) {
    this.graphics = graphics;
    this.points = null;
  }

  /** The corners of a camera's picture, and where it stands. */
  frustum(view) {
    const { lens, pose } = view, depth = this.frustumDepth;
    return [[0, 0], [lens.width, 0], [lens.width, lens.height], [0, lens.height]].map(([x, y]) => {
      const ray = [(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1];
      return add(pose.centre, scaled(toScene(pose.rotation, ray), depth));
    });
  }

  /** Draws over the canvas what `request` shows; `extras` are lines [from, to, colour]. */
  draw(request, extras, chosen) {
    const { gl } = this.graphics, { views } = this.contents, lines = [...extras];
    if (this.layers.cameras) {
      views.forEach((view, index) => {
        const corners = this.frustum(view), colour = index === chosen ? COLOURS.chosen : COLOURS[view.split];
        if (index === chosen) return;
        corners.forEach((corner, i) => lines.push([corner, corners[(i + 1) % 4], colour], [view.pose.centre, corner, colour]));
      });
    }
    if (this.layers.axes) AXES.forEach(([axis, colour]) => lines.push([[0, 0, 0], scaled(axis, 0.5), colour]));
    gl.useProgram(this.graphics.drawing.program);
    const lens = fitted(request.lens, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.uniformMatrix4fv(this.graphics.drawing.at("clipFromScene"), false, clipFromScene(request.pose, lens, OVERLAY_NEAR));
    gl.uniform1f(this.graphics.drawing.at("pointSize"), 2 * (window.devicePixelRatio || 1));
    if (this.layers.points) this.drawPoints();
    if (lines.length) this.drawLines(lines);
  }

  drawLines(lines) {
    const { gl } = this.graphics;
    const array = this.vertices(lines.flatMap(([from, to]) => [...from, ...to]), lines.flatMap(([, , c]) => [...c, ...c]));
    gl.bindVertexArray(array.object);
    gl.drawArrays(gl.LINES, 0, 2 * lines.length);
    gl.bindVertexArray(null);
    gl.deleteVertexArray(array.object);
    array.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
  }

  drawPoints() {
    const { gl } = this.graphics, xyz = this.contents.section("points_xyz");
    this.points ??= this.vertices(floats(xyz), Array.from(this.contents.section("points_rgb"), (c) => c / 255));
    gl.bindVertexArray(this.points.object);
    gl.drawArrays(gl.POINTS, 0, xyz.byteLength / 12);
    gl.bindVertexArray(null);
  }

  vertices(...attributes) {
    const { gl } = this.graphics, object = gl.createVertexArray();
    gl.bindVertexArray(object);
    const buffers = attributes.map((values, index) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, 3, gl.FLOAT, false, 0, 0);
      return buffer;
    });
    gl.bindVertexArray(null);
    return { object, buffers };
  }
}

/** The edges of a box as lines. */
function boxLines({ low, high }, colour) {
  const corner = (i) => [0, 1, 2].map((axis) => ((i >> axis) & 1 ? high : low)[axis]);
  return [0, 1, 2].flatMap((axis) =>
    [0, 1, 2, 3, 4, 5, 6, 7].filter((i) => !((i >> axis) & 1)).map((i) => [corner(i), corner(i | (1 << axis)), colour]));
}
