// All of WebGL that holds the field: programs, textures, uniform blocks. Made anew when a lost context comes back.

const TEXTURE_WIDTH = 2048; // as in field.glsl
const VIEWS = { colour: 0, depth: 1, normals: 2, opacity: 3, cost: 4 };
const MAX_STEPS = 8192; // of a ray, empty ones included; hops over empty bricks keep real rays far below
const BLOCKS = ["DensityNetwork", "ColourNetwork"];

class Graphics {
  constructor(canvas, contents) {
    this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: true, preserveDrawingBuffer: false });
    if (!this.gl) throw new Error("no WebGL2");
    const { gl } = this, { field } = contents;
    this.field = this.program(
      "out vec2 at;\nvoid main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }",
      [defines(field), SHADERS.space, SHADERS.field, SHADERS.march].join("\n"));
    this.quad = this.program("#define VERTEX\n#define QUAD\n" + SHADERS.overlay, "#define QUAD\n" + SHADERS.overlay);
    this.copying = this.program("#define VERTEX\n#define QUAD\n" + SHADERS.overlay, "#define QUAD\n#define COPY\n" + SHADERS.overlay);
    const margins = `#define RELATIVE_MARGIN ${RELATIVE_MARGIN}\n#define MARGIN ${MARGIN}\n`;
    this.drawing = this.program("#define VERTEX\n" + SHADERS.overlay, margins + SHADERS.overlay);
    this.load(contents);
  }

  /** Hands the numbers of a field of the same sizes to the graphics chip, in place of those before. */
  load(contents) {
    const { gl } = this, { field, section } = contents;
    this.contents = contents;
    this.buffers?.forEach((buffer) => gl.deleteBuffer(buffer));
    this.textures?.forEach((texture) => gl.deleteTexture(texture));
    this.buffers = ["density_network", "colour_network"].map((name, index) => this.block(index, floats(section(name))));
    const table = field.by_rows ? section("table").slice() : interleaved(section("table"), field.levels, field.bits / 8);
    const format = field.bits === 8 ? [gl.RGBA8_SNORM, gl.BYTE, new Int8Array(table.buffer)] : half(gl, table);
    this.textures = [
      this.texture(gl.RGBA, ...format, 4),
      this.texture(gl.RGBA_INTEGER, gl.RGBA32UI, gl.UNSIGNED_INT,
        occupancyTexels(section("occupancy"), section("empty_distance")), 4),
      this.texture(gl.RGBA, gl.RGBA8, gl.UNSIGNED_BYTE, section("palette"), 4),
    ];
    const background = section("background");
    if (background) this.textures.push(this.texture(gl.RGBA, ...half(gl, background), 4));
    this.setConstants();
  }

  program(vertex, fragment) {
    const { gl } = this, program = gl.createProgram();
    const head = "#version 300 es\n" + ["float", "int", "sampler2D", "usampler2D"].map((type) => `precision highp ${type};\n`).join("");
    for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, head + text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error([gl.getProgramInfoLog(program), ...gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s))].join("\n"));
    }
    const places = new Map();
    return {
      program,
      at: (name) => places.get(name) ?? places.set(name, gl.getUniformLocation(program, name)).get(name),
    };
  }

  /** Rows of a table, one a texel. */
  texture(format, internal, type, values, perTexel) {
    const { gl } = this, texture = gl.createTexture();
    const height = Math.ceil(values.length / perTexel / TEXTURE_WIDTH);
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("the field is larger than this graphics chip's textures");
    const padded = new values.constructor(perTexel * TEXTURE_WIDTH * height);
    padded.set(values);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, TEXTURE_WIDTH, height, 0, format, type, padded);
    return texture;
  }

  /** A uniform block with its numbers. */
  block(index, values) {
    const { gl } = this, buffer = gl.createBuffer();
    gl.bindBufferBase(gl.UNIFORM_BUFFER, index, buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, values, gl.STATIC_DRAW);
    gl.uniformBlockBinding(this.field.program, gl.getUniformBlockIndex(this.field.program, BLOCKS[index]), index);
    return buffer;
  }

  setConstants() {
    const { gl } = this, { at } = this.field, { field, inverse_depth: range } = this.contents;
    gl.useProgram(this.field.program);
    ["table", "occupancy", "palette", "backgroundTable"].forEach((name, index) => gl.uniform1i(at(name), index));
    gl.uniform4iv(at("levels"), levelNumbers(field.levels));
    if (field.background_levels.length) gl.uniform4iv(at("backgroundLevels"), levelNumbers(field.background_levels));
    gl.uniform1f(at("stepSize"), field.step_size);
    gl.uniform1f(at("coneAngle"), field.cone_angle);
    gl.uniform2fv(at("inverseDepthRange"), range);
    const { space } = field;
    if (space.kind === "ndc") {
      gl.uniform3fv(at("apex"), space.apex);
      gl.uniformMatrix3fv(at("axesFromScene"), true, space.axes.flat());
      gl.uniform2fv(at("slopes"), space.slopes);
      gl.uniform1f(at("nearPlane"), space.near);
    }
  }

  /** A picture to draw into: its colours and the distances of its surface as textures, and their framebuffer. */
  target(width, height) {
    const { gl } = this, framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const [texture, distances] = [[gl.RGBA8, gl.LINEAR], [gl.R32UI, gl.NEAREST]].map(([format, filter], index) => {
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
      for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, wrap, gl.CLAMP_TO_EDGE);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + index, gl.TEXTURE_2D, made, 0);
      return made;
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    return { texture, distances, framebuffer, width, height };
  }

  free(target) {
    this.gl.deleteTexture(target.texture);
    this.gl.deleteTexture(target.distances);
    this.gl.deleteFramebuffer(target.framebuffer);
  }

  /** Draws the rows from, ..., to - 1 (from the bottom) of the picture that `request` asks for; see Renderer.request. */
  draw(target, request, from = 0, to = target.height) {
    const { gl } = this, { at, program } = this.field, lens = fitted(request.lens, target.width, target.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, from, target.width, to - from);
    gl.useProgram(program);
    this.textures.forEach((texture, index) => {
      gl.activeTexture(gl.TEXTURE0 + index);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform1i(at("view"), VIEWS[request.view]);
    gl.uniform2f(at("size"), target.width, target.height);
    gl.uniform4f(at("lens"), lens.fx, lens.fy, lens.cx, lens.cy);
    gl.uniformMatrix3fv(at("sceneFromCamera"), false, request.pose.rotation);
    gl.uniform3fv(at("centre"), request.pose.centre);
    gl.uniform2fv(at("nearFar"), request.nearFar);
    gl.uniform1i(at("cropped"), request.crop ? 1 : 0);
    if (request.crop) {
      gl.uniform3fv(at("cropLow"), request.crop.low);
      gl.uniform3fv(at("cropHigh"), request.crop.high);
    }
    gl.uniform1f(at("maxSamples"), this.contents.field.max_samples);
    gl.uniform1f(at("opacityStep"), request.opacityStep);
    gl.uniform3fv(at("background"), request.background);
    gl.uniform3fv(at("logGain"), request.logGain);
    gl.uniform4fv(at("falloff"), request.falloff);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** Shows a picture on the canvas. */
  present(target) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.useProgram(this.quad.program);
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Copies a picture into another of any size. */
  copy(from, to) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, to.framebuffer);
    gl.viewport(0, 0, to.width, to.height);
    gl.useProgram(this.copying.program); // blitFramebuffer of the two attachments leaves stripes in SwiftShader
    gl.uniform1i(this.copying.at("surfaces"), 1);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, from.distances);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, from.texture);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** The bytes of a picture, rows from the bottom. */
  read(target) {
    const { gl } = this, bytes = new Uint8Array(4 * target.width * target.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.readPixels(0, 0, target.width, target.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }

  /** The distance of the surface that the first pixel shows; infinite in empty space. */
  readDistance(target) {
    const { gl } = this, word = new Uint32Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.readBuffer(gl.COLOR_ATTACHMENT1);
    gl.readPixels(0, 0, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, word);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    return new Float32Array(word.buffer)[0];
  }
}

function defines(field) {
  const numbers = {
    [`SPACE_${field.space.kind.toUpperCase()}`]: 1,
    HALF: field.space.half.toFixed(6),
    CELLS: field.occupancy_resolution,
    BRICKS: field.occupancy_resolution / 4,
    LEVELS: field.levels.length,
    MAX_STEPS,
    ...(field.view_dependence && { DIRECTIONS: 1 }),
    ...(field.background_levels.length && { BACKGROUND_LEVELS: field.background_levels.length }),
  };
  return Object.entries(numbers).map(([name, value]) => `#define ${name} ${value}`).join("\n");
}

const levelNumbers = (levels) => levels.flatMap((level) => [level.resolution, level.first_row, level.mask, 0]);

/** Half-precision floats for a texture. */
function half(gl, bytes) {
  return [gl.RGBA16F, gl.HALF_FLOAT, new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2)];
}
