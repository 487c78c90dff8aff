// Draws the robot, the targets and the board in WebGL 2. Matrices are column by column, as WebGL wants them.

// The run's world as the operator has it: x forward, y left, z up, and the robot a step ahead.
const WORLD = new Float32Array([0, 0, -1, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -0.7, 1]);
const BOARD = new Float32Array([0.6, 0, 0, 0, 0, 0.375, 0, 0, 0, 0, 1, 0, 0, 1.75, -2.0, 1]); // 1.2 m wide
const AXES = [[0.9, 0.2, 0.2], [0.2, 0.75, 0.3], [0.25, 0.45, 0.95]];
const [LENGTH, THICKNESS, KNOB] = [0.1, 0.004, 0.02]; // of a target's axes, and its middle [m]
const FIELD_OF_VIEW = 0.9; // of the page, upwards [rad]
const [DOWN, ACROSS] = [Math.sin(0.25), Math.cos(0.25)]; // of a look from 1.6 m up and 1.2 m behind
const BEHIND = new Float32Array([
  1, 0, 0, 0, 0, ACROSS, DOWN, 0, 0, -DOWN, ACROSS, 0,
  0, -1.6 * ACROSS + 1.2 * DOWN, -1.6 * DOWN - 1.2 * ACROSS, 1,
]);
const GHOST = 0.45; // opacity in the operator's own room

const SHAPES = {
  vertex: `#version 300 es
    uniform mat4 view, model; in vec3 position; out vec3 seen;
    void main() { vec4 place = view * model * vec4(position, 1.0); seen = place.xyz; gl_Position = place; }`,
  solid: `#version 300 es
    precision highp float; uniform vec4 colour; uniform mat4 model; in vec3 seen; out vec4 shown;
    void main() {
      vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
      shown = vec4(colour.rgb * (0.55 + 0.45 * abs(normal.z)), 1.0) * colour.a;
    }`,
};
const BOARDS = {
  vertex: `#version 300 es
    uniform mat4 view, model; in vec3 position; out vec2 at;
    void main() { at = vec2(0.5 + 0.5 * position.x, 0.5 - 0.5 * position.y); gl_Position = view * model * vec4(position, 1.0); }`,
  solid: `#version 300 es
    precision highp float; uniform sampler2D picture; in vec2 at; out vec4 shown;
    void main() { shown = texture(picture, at); }`,
};

export function times(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

// Of a pose x y z qx qy qz qw.
export function matrixOf([px, py, pz, x, y, z, w]) {
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0,
    px, py, pz, 1,
  ]);
}

// A box from `low` to `high`.
function boxOf(low, high) {
  const vertices = [];
  for (let corner = 0; corner < 8; corner++)
    for (let axis = 0; axis < 3; axis++) vertices.push((corner >> axis) & 1 ? high[axis] : low[axis]);
  const faces = [0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4, 2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4, 6, 1, 3, 5, 3, 7, 5];
  return { vertices, faces };
}

// Where each eye of a headset's frame is drawn, and how it sees; none where the head is not tracked.
export function eyesOf(frame, space) {
  const layer = frame.session.renderState.baseLayer;
  return (frame.getViewerPose(space)?.views ?? [])
    .map((eye) => {
      const { x, y, width, height } = layer.getViewport(eye);
      return { x, y, width, height, view: times(eye.projectionMatrix, eye.transform.inverse.matrix) };
    })
    .filter(({ width }) => width > 0);
}

// Of a screen so many times as wide as high.
function projection(aspect) {
  const [near, far, scale] = [0.1, 20, 1 / Math.tan(FIELD_OF_VIEW / 2)];
  const depth = [(far + near) / (near - far), (2 * far * near) / (near - far)];
  return new Float32Array([scale / aspect, 0, 0, 0, 0, scale, 0, 0, 0, 0, depth[0], -1, 0, 0, depth[1], 0]);
}

export class Drawing {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { xrCompatible: true, antialias: true });
    this.gl = gl;
    if (!gl) return; // the hands are sent all the same
    this.shapes = this.program(SHAPES);
    this.boards = this.program(BOARDS);
    const half = THICKNESS / 2;
    this.axes = AXES.map((colour, axis) => {
      const [low, high] = [[-half, -half, -half], [half, half, half]];
      high[axis] = LENGTH;
      return { ...this.mesh(boxOf(low, high)), colour };
    });
    this.knob = this.mesh(boxOf([-KNOB / 2, -KNOB / 2, -KNOB / 2], [KNOB / 2, KNOB / 2, KNOB / 2]));
    this.board = this.mesh({ vertices: [-1, -1, 0, 1, -1, 0, -1, 1, 0, 1, 1, 0], faces: [0, 1, 2, 2, 1, 3] });
    this.texture = gl.createTexture();
    this.robot = [];
  }

  program({ vertex, solid }) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, solid]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const place = (name) => gl.getUniformLocation(program, name);
    return { program, view: place("view"), model: place("model"), colour: place("colour") };
  }

  mesh({ vertices, faces }) {
    const { gl } = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(faces), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: faces.length };
  }

  setScene({ meshes }) {
    if (this.gl) this.robot = meshes.map((mesh) => ({ ...this.mesh(mesh), joint: mesh.joint, colour: mesh.colour }));
  }

  async bind(session) {
    const { gl } = this;
    if (!gl) throw new Error("This browser has no WebGL 2.");
    await gl.makeXRCompatible();
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
  }

  // On the page itself, as seen from behind the robot.
  drawOnPage(state, panel) {
    if (!this.gl) return;
    const { canvas } = this.gl;
    [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight];
    const [width, height] = [canvas.width, canvas.height];
    const view = times(projection(width / height), BEHIND);
    this.draw(null, [{ x: 0, y: 0, width, height, view }], state, panel, false);
  }

  draw(framebuffer, eyes, state, panel, transparent) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.clearColor(...(transparent ? [0, 0, 0, 0] : [0.93, 0.945, 0.957, 1]));
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (panel.changed) {
      panel.changed = false;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, panel.canvas);
      gl.generateMipmap(gl.TEXTURE_2D);
    }
    for (const { x, y, width, height, view } of eyes) {
      gl.viewport(x, y, width, height);
      gl.useProgram(this.boards.program);
      gl.uniformMatrix4fv(this.boards.view, false, view);
      this.show(this.boards, this.board, BOARD);
      gl.useProgram(this.shapes.program);
      gl.uniformMatrix4fv(this.shapes.view, false, view);
      if (state) this.drawRun(state, transparent ? GHOST : 1);
    }
  }

  drawRun({ joints, arms }, opacity) {
    const places = joints.map((joint) => times(WORLD, matrixOf(joint)));
    for (const { target, colour } of Object.values(arms)) {
      if (!target) continue;
      const place = times(WORLD, matrixOf(target));
      for (const axis of this.axes) this.show(this.shapes, axis, place, axis.colour);
      this.show(this.shapes, this.knob, place, colour.map((part) => part / 255));
    }
    for (const mesh of this.robot) {
      if (opacity < 1 && mesh.joint === 0) continue; // what does not move would hide the room
      this.show(this.shapes, mesh, places[mesh.joint], mesh.colour.map((part) => part / 255), opacity);
    }
  }

  show(program, mesh, model, colour, opacity = 1) {
    const { gl } = this;
    gl.uniformMatrix4fv(program.model, false, model);
    if (colour) gl.uniform4f(program.colour, ...colour, opacity);
    gl.bindVertexArray(mesh.array);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
  }
}
