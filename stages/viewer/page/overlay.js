// The layers over the picture: cameras, sparse points, the mesh, the crop box, axes. The picture's surface hides what lies
// behind it; the measured line alone is always seen.

const COLOURS = {
  train: [0.35, 0.65, 1], validation: [0.35, 0.65, 1], test: [1, 0.65, 0.2],
  crop: [1, 0.9, 0.3], measure: [1, 0.25, 0.55], path: [0.4, 0.95, 0.5],
};
const AXES = [[[1, 0, 0], [0.95, 0.3, 0.3]], [[0, 1, 0], [0.35, 0.8, 0.35]], [[0, 0, 1], [0.4, 0.55, 1]]];
const OVERLAY_NEAR = 0.01; // scene units
const LINE_PX = 1.5; // CSS pixels
const SHADINGS = { plain: 0, coloured: 1, clay: 2 };
// A point lies behind a surface that is nearer by more than this, for what lies on the surface is to be seen.
const RELATIVE_MARGIN = 0.01, MARGIN = 0.015; // of the distance; in scene units
const MESH_BEHIND = [1, 16]; // polygon offset: points and lines on the mesh stand before it

class Overlay {
  constructor(contents) {
    Object.assign(this, { contents, layers: { cameras: false, points: false, mesh: false, axes: false }, isClay: false });
    const centres = contents.views.map((view) => view.pose.centre);
    const spread = Math.max(...[0, 1, 2].map((axis) => Math.max(...centres.map((c) => c[axis])) - Math.min(...centres.map((c) => c[axis]))));
    this.frustumDepth = clamp(0.04 * spread, 0.01, 0.2);
  }

  restore(graphics) {
    this.graphics = graphics;
    this.points = this.mesh = null;
  }

  /** The corners of a camera's picture, and where it stands. */
  frustum(view) {
    const { lens, pose } = view, depth = this.frustumDepth;
    return [[0, 0], [lens.width, 0], [lens.width, lens.height], [0, lens.height]].map(([x, y]) => {
      const ray = [(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1];
      return add(pose.centre, scaled(toScene(pose.rotation, ray), depth));
    });
  }

  /** Draws into the canvas, which shows `target`, what `request` shows; `lines` and lines that nothing hides, `above`,
   *  are [from, to, colour]. The crop box applies to points and mesh: cameras mostly stand outside of it. */
  draw(request, target, { lines, above }, chosen) {
    const { gl } = this.graphics, shown = [...lines];
    if (this.layers.cameras) shown.push(...this.cameraLines(chosen, request.pose.centre));
    if (this.layers.axes) AXES.forEach(([axis, colour]) => shown.push([[0, 0, 0], scaled(axis, 0.5), colour]));
    this.begin(request, target);
    if (this.layers.mesh) this.drawMesh(request.crop);
    if (this.layers.points) this.drawPoints(request.crop);
    if (shown.length) this.drawLines(shown);
    gl.disable(gl.DEPTH_TEST);
    if (above.length) this.drawLines(above, false);
  }

  begin(request, target) {
    const { gl, drawing } = this.graphics, { at } = drawing, [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    gl.useProgram(drawing.program);
    gl.bindTexture(gl.TEXTURE_2D, target.distances);
    gl.uniformMatrix4fv(at("clipFromScene"), false, clipFromScene(request.pose, fitted(request.lens, width, height), OVERLAY_NEAR));
    gl.uniform1f(at("pointSize"), 2 * (window.devicePixelRatio || 1));
    gl.uniform2f(at("size"), width, height);
    gl.uniform3fv(at("eye"), request.pose.centre);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
  }

  /** How vertices that are drawn next are placed, shaded, hidden and cropped. */
  set({ middle = [0, 0, 0], radius = 1, shading = "plain", hides = true, crop = null }) {
    const { gl, drawing: { at } } = this.graphics;
    gl.uniform4f(at("ball"), ...middle, radius);
    gl.uniform1i(at("shading"), SHADINGS[shading]);
    gl.uniform1i(at("hides"), hides ? 1 : 0);
    gl.uniform1i(at("cropped"), crop ? 1 : 0);
    if (!crop) return;
    gl.uniform3fv(at("cropLow"), crop.low);
    gl.uniform3fv(at("cropHigh"), crop.high);
  }

  /** Not of the camera that the eye stands in: its edges would lie across the picture. */
  cameraLines(chosen, eye) {
    return this.contents.views.flatMap((view, index) => {
      if (index === chosen || norm(subtract(view.pose.centre, eye)) < 0.5 * this.frustumDepth) return [];
      const corners = this.frustum(view), colour = COLOURS[view.split];
      return corners.flatMap((corner, i) => [[corner, corners[(i + 1) % 4], colour], [view.pose.centre, corner, colour]]);
    });
  }

  drawLines(lines, hides = true) {
    const { gl } = this.graphics;
    const positions = new Float32Array(lines.flatMap(([from, to]) => [...from, ...to]));
    const array = this.vertices(positions, new Float32Array(lines.flatMap(([, , c]) => [...c, ...c])));
    this.set({ hides });
    gl.bindVertexArray(array.object);
    const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight], wide = Math.ceil(LINE_PX * (window.devicePixelRatio || 1));
    for (let place = 0; place < wide * wide; ++place) { // WebGL draws lines of one pixel alone
      gl.viewport(place % wide, Math.floor(place / wide), width, height);
      gl.drawArrays(gl.LINES, 0, 2 * lines.length);
    }
    gl.viewport(0, 0, width, height);
    gl.bindVertexArray(null);
    gl.deleteVertexArray(array.object);
    array.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
  }

  drawPoints(crop) {
    const { gl } = this.graphics, { section } = this.contents;
    this.points ??= this.vertices(floats(section("points_xyz")), section("points_rgb"));
    this.set({ crop });
    gl.bindVertexArray(this.points.object);
    gl.drawArrays(gl.POINTS, 0, this.points.count);
    gl.bindVertexArray(null);
  }

  drawMesh(crop) {
    const { gl } = this.graphics, { section, mesh } = this.contents;
    const words = (bytes, kind) => new kind(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
    this.mesh ??= this.vertices(words(section("mesh_positions"), Int16Array), section("mesh_colours"), words(section("mesh_faces"), Uint16Array));
    this.set({ ...mesh, crop, shading: this.isClay ? "clay" : "coloured" });
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(...MESH_BEHIND);
    gl.bindVertexArray(this.mesh.object);
    gl.drawElements(gl.TRIANGLES, this.mesh.faces.length, gl.UNSIGNED_SHORT, 0);
    gl.bindVertexArray(null);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  /** Positions and colours of vertices, three numbers each: floats, or integers of which the largest is 1; faces or none. */
  vertices(positions, colours, faces = null) {
    const { gl } = this.graphics, object = gl.createVertexArray();
    const kinds = new Map([[Float32Array, gl.FLOAT], [Int16Array, gl.SHORT], [Uint8Array, gl.UNSIGNED_BYTE]]);
    const buffers = [];
    const filled = (kind, values) => {
      buffers.push(gl.createBuffer());
      gl.bindBuffer(kind, buffers.at(-1));
      gl.bufferData(kind, values, gl.STATIC_DRAW);
    };
    gl.bindVertexArray(object);
    [positions, colours].forEach((values, index) => {
      filled(gl.ARRAY_BUFFER, values);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, 3, kinds.get(values.constructor), true, 0, 0);
    });
    if (faces) filled(gl.ELEMENT_ARRAY_BUFFER, faces);
    gl.bindVertexArray(null);
    return { object, buffers, faces, count: positions.length / 3 };
  }
}

/** A cross at a point, along the axes of the scene. */
function crossLines(point, size, colour) {
  return AXES.map(([axis]) => [subtract(point, scaled(axis, size)), add(point, scaled(axis, size)), colour]);
}

/** The edges of a box as lines. */
function boxLines({ low, high }, colour) {
  const corner = (i) => [0, 1, 2].map((axis) => ((i >> axis) & 1 ? high : low)[axis]);
  return [0, 1, 2].flatMap((axis) =>
    [0, 1, 2, 3, 4, 5, 6, 7].filter((i) => !((i >> axis) & 1)).map((i) => [corner(i), corner(i | (1 << axis)), colour]));
}
