// The mesh of the report, turned by mouse, touch and arrow keys. Without WebGL 2 its picture stays.

const VERTEX = `#version 300 es
uniform mat3 rotation; uniform vec2 stretch; uniform float zoom;
in vec3 position; in vec3 colour;
out vec3 tint, place;
void main() {
  place = rotation * position;
  tint = colour;
  gl_Position = vec4(place.xy * stretch * zoom, -0.4 * place.z, 1.0 - 0.3 * place.z);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 tint, place;
uniform bool clay;
out vec4 shown;
void main() {
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = abs(normal.z);
  shown = vec4(clay ? vec3(0.78) * (0.3 + 0.7 * light) : tint * (0.8 + 0.2 * light), 1.0);
}`;

/** Bytes of base64: vertices as three 16-bit numbers, faces as 16-bit indices, then
 *  three bytes of colour each; `start`: how far the eye is turned and lifted. */
function turntable(canvas, { vertices, faces, start, data }) {
  const gl = canvas.getContext("webgl2", { alpha: true, antialias: true, preserveDrawingBuffer: false });
  if (!gl) return;
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0)).buffer;
  let program, turn = start[0], tilt = start[1], zoom = 0.9, clay = false;
  const set = (name) => gl.getUniformLocation(program, name);
  const build = () => {
    program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    const attribute = (name, array, kind) => {
      const place = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, kind, true, 0, 0);
    };
    attribute("position", new Int16Array(bytes, 0, 3 * vertices), gl.SHORT);
    attribute("colour", new Uint8Array(bytes, 6 * vertices + 6 * faces, 3 * vertices), gl.UNSIGNED_BYTE);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(bytes, 6 * vertices, 3 * faces), gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);
  };
  const draw = () => {
    const ratio = window.devicePixelRatio || 1, width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const [c, s, d, e] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)], aspect = width / height;
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    // Columns: where x, y and z (up) of the scene go to the right, up and towards the eye.
    gl.uniformMatrix3fv(set("rotation"), false, [c, -e * s, s * d, s, e * c, -c * d, 0, d, e]);
    gl.uniform2f(set("stretch"), aspect > 1 ? 1 / aspect : 1, aspect > 1 ? 1 : aspect);
    gl.uniform1f(set("zoom"), zoom);
    gl.uniform1i(set("clay"), clay ? 1 : 0);
    gl.drawElements(gl.TRIANGLES, 3 * faces, gl.UNSIGNED_SHORT, 0);
  };
  const move = (x, y, factor = 1) => {
    turn += x;
    tilt = Math.min(1.5, Math.max(-1.5, tilt + y));
    zoom = Math.min(8, Math.max(0.3, zoom * factor));
    draw();
  };
  const fingers = new Map(), apart = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15] };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const before = fingers.size > 1 ? apart() : 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before) move(0, 0, apart() / before);
    else move((last.x - event.clientX) / 120, (event.clientY - last.y) / 120);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return; // the wheel alone scrolls the page
    event.preventDefault();
    move(0, 0, Math.exp(-event.deltaY * 0.01));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (!(event.key in keys)) return;
    event.preventDefault();
    move(...keys[event.key]);
  });
  document.getElementById("clay").addEventListener("change", (event) => {
    clay = event.target.checked;
    draw();
  });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    build();
    draw();
  });
  document.body.classList.add("turns");
  build();
  new ResizeObserver(draw).observe(canvas);
}
