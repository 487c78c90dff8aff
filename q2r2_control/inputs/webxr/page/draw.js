// Draws the run, and the board with its texts, in WebGL 2.

import { Board } from "./board.js";
import { beamOf, inverseOf, matrixOf, projection, scaleOf, times } from "./matrices.js";
import { boxOf, gridOf } from "./shapes.js";

// The pose of the run's world frame (x forward, y left, z up) in the operator's room: the robot is a step ahead.
const WORLD = new Float32Array([0, 0, -1, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -0.7, 1]);
const ROOM = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
const AXES = [[0.9, 0.2, 0.2], [0.2, 0.75, 0.3], [0.25, 0.45, 0.95]];
const [LENGTH, THICKNESS, KNOB] = [0.1, 0.004, 0.02]; // size of a target's axes, and width of its knob [m]
const [LEASH, PAIR] = [0.003, 0.006]; // thickness of the lines for the leash and the tightest pair [m]
const [AMBER, RED, GREEN] = [[0.9, 0.63, 0.12], [0.84, 0.22, 0.22], [0.18, 0.63, 0.35]];
const [GREY, LINES, GHOST] = [[0.35, 0.38, 0.41], [0.62, 0.66, 0.7], [0.47, 0.63, 0.9]];
const SHORT = 0.01; // a leash up to this length is not drawn [m]
const CALM = 0.1; // the tightest pair is green if its margin is at least this [m]
const CONTROLLER = [0.035, 0.035, 0.11]; // size of the box that shows a controller [m]
const FIELD_OF_VIEW = 0.9; // vertical angle of view on the page [rad]
// On the page, the camera is 1.6 m up and 1.2 m behind the origin of the room. It looks down by 0.42 rad.
const [DOWN, ACROSS] = [Math.sin(0.42), Math.cos(0.42)];
const BEHIND = new Float32Array([
  1, 0, 0, 0, 0, ACROSS, DOWN, 0, 0, -DOWN, ACROSS, 0,
  0, -1.6 * ACROSS + 1.2 * DOWN, -1.6 * DOWN - 1.2 * ACROSS, 1,
]);
// Each time that drawing is slow, the number of pixels along a side is multiplied by the first factor. The second
// number is the least share of pixels that remains.
const [COARSER, COARSEST] = [0.8, 0.3];
const [AR_OPACITY, GHOST_OPACITY] = [0.45, 0.35]; // opacity of the robot in AR, and of the gripper at a target

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

/**
 * @typedef {{ array: WebGLVertexArrayObject, count: number }} Mesh a shape on the graphics card; number of corners
 * @typedef {{ program: WebGLProgram, view: WebGLUniformLocation | null, model: WebGLUniformLocation | null, colour: WebGLUniformLocation | null }} Program
 * @typedef {{ x: number, y: number, width: number, height: number, view: Float32Array }} Eye
 */

/**
 * Return the viewport and the view matrix of each eye in a headset's frame; empty if the head is not tracked.
 * @param {XRFrame} frame
 * @param {XRReferenceSpace} space
 * @returns {Eye[]}
 */
export function eyesOf(frame, space) {
  const layer = /** @type {XRWebGLLayer} */ (frame.session.renderState.baseLayer);
  return (frame.getViewerPose(space)?.views ?? [])
    .map((eye) => {
      const { x, y, width, height } = /** @type {XRViewport} */ (layer.getViewport(eye));
      return { x, y, width, height, view: times(eye.projectionMatrix, eye.transform.inverse.matrix) };
    })
    .filter(({ width }) => width > 0);
}

export class Drawing {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.board = new Board();
    /** @type {ShownScene | null} */
    this.scene = null;
    const gl = canvas.getContext("webgl2", { xrCompatible: true, antialias: true });
    this.gl = /** @type {WebGL2RenderingContext} */ (gl); // null without WebGL 2; the hands are sent nevertheless
    this.shapes = this.program(SHAPES);
    this.boards = this.program(BOARDS);
    const half = THICKNESS / 2;
    this.axes = AXES.map((colour, axis) => {
      const [low, high] = [[-half, -half, -half], [half, half, half]];
      high[axis] = LENGTH;
      return { mesh: this.mesh(boxOf(low, high)), colour };
    });
    this.cube = this.mesh(boxOf([-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]));
    this.square = this.mesh({ vertices: [-1, -1, 0, 1, -1, 0, -1, 1, 0, 1, 1, 0], faces: [0, 1, 2, 2, 1, 3] });
    this.texture = gl ? gl.createTexture() : null;
    /** @type {{ mesh: Mesh, joint: number, colour: number[] }[]} */
    this.robot = [];
    /** @type {Mesh | null} */
    this.grid = null;
    /** @type {WebGLSync | null} */
    this.busy = null; // signals that the last picture on the page is finished
    this.sharpness = 1; // number of the picture's pixels per pixel of the page, along a side
  }

  /**
   * @param {{ vertex: string, solid: string }} sources
   * @returns {Program}
   */
  program({ vertex, solid }) {
    const { gl } = this;
    if (!gl) return /** @type {any} */ ({});
    const program = gl.createProgram();
    for (const [kind, source] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, solid]])) {
      const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(String(gl.getProgramInfoLog(program)));
    /** @param {string} name */
    const place = (name) => gl.getUniformLocation(program, name);
    return { program, view: place("view"), model: place("model"), colour: place("colour") };
  }

  /**
   * @param {{ vertices: number[], faces: number[] }} shape
   * @returns {Mesh}
   */
  mesh({ vertices, faces }) {
    const { gl } = this;
    if (!gl) return /** @type {any} */ ({});
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

  /** @param {ShownScene} scene */
  setScene(scene) {
    this.scene = scene;
    if (!this.gl) return;
    this.robot = scene.meshes.map((shape) => ({
      mesh: this.mesh(shape),
      joint: shape.joint,
      colour: shape.colour.map((part) => part / 255),
    }));
    this.grid = this.mesh(gridOf(scene.floor));
  }

  /** @param {XRSession} session */
  async bind(session) {
    const { gl } = this;
    if (!gl) throw new Error("This browser has no WebGL 2.");
    await gl.makeXRCompatible();
    this.board = new Board();
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
  }

  /** @param {ArrayLike<number> | undefined} head matrix of the operator's head, if it is tracked */
  lookFrom(head) {
    if (head) this.board.lookFrom(head);
  }

  /**
   * Draw the run on the page, as seen from behind the robot, without the board. Return whether it was drawn: while the
   * last picture is not finished, nothing is drawn, because otherwise the page could not react to keys.
   * @param {ShownState | null} state
   */
  drawOnPage(state) {
    const { gl } = this;
    if (!gl || (this.busy && gl.getSyncParameter(this.busy, gl.SYNC_STATUS) !== gl.SIGNALED)) return false;
    const canvas = /** @type {HTMLCanvasElement} */ (gl.canvas);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.ceil(this.sharpness * side));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const view = times(projection(width / height, FIELD_OF_VIEW), BEHIND);
    this.draw(null, [{ x: 0, y: 0, width, height, view }], state, null, [], false);
    gl.deleteSync(this.busy);
    this.busy = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return true;
  }

  // Draw fewer pixels from now on, because a picture took long, for example on a computer without a graphics card.
  coarsen() {
    this.sharpness = Math.max(COARSER * this.sharpness, COARSEST);
  }

  /**
   * @param {WebGLFramebuffer | null} framebuffer
   * @param {Eye[]} eyes
   * @param {ShownState | null} state
   * @param {import("./panel.js").Panel | null} panel the panel whose picture the board shows; null for no board
   * @param {Float32Array[]} hands poses of the hands, as matrices in the operator's room
   * @param {boolean} transparent whether the operator sees the real room, as in AR
   */
  draw(framebuffer, eyes, state, panel, hands, transparent) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    if (transparent) gl.clearColor(0, 0, 0, 0);
    else gl.clearColor(0.93, 0.945, 0.957, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (panel?.changed) {
      panel.changed = false;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, panel.canvas);
      gl.generateMipmap(gl.TEXTURE_2D);
    }
    for (const { x, y, width, height, view } of eyes) {
      gl.viewport(x, y, width, height);
      if (panel) {
        gl.useProgram(this.boards.program);
        gl.uniformMatrix4fv(this.boards.view, false, view);
        this.show(this.boards, this.square, this.board.place(panel.canvas.height / panel.canvas.width));
      }
      gl.useProgram(this.shapes.program);
      gl.uniformMatrix4fv(this.shapes.view, false, view);
      for (const hand of hands) this.shape(this.cube, ROOM, times(hand, scaleOf(CONTROLLER)), GREY);
      if (state && this.scene) this.drawRun(state, this.scene, transparent);
    }
  }

  /**
   * @param {ShownState} state
   * @param {ShownScene} scene
   * @param {boolean} transparent
   */
  drawRun({ joints, arms, parts, pair }, scene, transparent) {
    const places = joints.map(matrixOf);
    if (this.grid && !transparent) this.shape(this.grid, WORLD, ROOM, LINES);
    for (const [name, pose] of Object.entries(parts)) {
      const { size, colour } = scene.parts[name];
      this.shape(this.cube, WORLD, times(matrixOf(pose), scaleOf(size)), colour.map((part) => part / 255));
    }
    for (const arm of Object.values(arms)) if (arm.target) this.drawTarget(arm, arm.target);
    if (pair) {
      const calm = Math.min(Math.max(pair.margin / CALM, 0), 1);
      const colour = GREEN.map((part, index) => calm * part + (1 - calm) * RED[index]);
      this.shape(this.cube, WORLD, beamOf(pair.ends[0], pair.ends[1], PAIR), colour);
    }
    for (const { mesh, joint, colour } of this.robot) {
      if (transparent && joint === 0) continue; // shapes that never move would hide the room
      this.shape(mesh, WORLD, places[joint], colour, transparent ? AR_OPACITY : 1);
    }
    for (const [name, arm] of Object.entries(arms)) {
      const way = arm.target && leashOf(arm.tool, arm.target);
      if (arm.target && way && way > SHORT) this.drawGhost(scene.hands[name], places, arm.tool, arm.target);
    }
  }

  /**
   * Draw a target's axes, a knob in the colour of the arm's state, and the leash from the tool to the target.
   * @param {ShownArm} arm
   * @param {Seven} target
   */
  drawTarget({ tool, colour }, target) {
    const place = matrixOf(target);
    for (const axis of this.axes) this.shape(axis.mesh, WORLD, place, axis.colour);
    this.shape(this.cube, WORLD, times(place, scaleOf([KNOB, KNOB, KNOB])), colour.map((part) => part / 255));
    if (leashOf(tool, target) > SHORT) {
      const ends = [tool, target].map(([x, y, z]) => /** @type {Point} */ ([x, y, z]));
      this.shape(this.cube, WORLD, beamOf(ends[0], ends[1], LEASH), AMBER);
    }
  }

  /**
   * Draw a translucent gripper at the target.
   * @param {number[]} joints indices of the joints whose shapes move with the tool
   * @param {Float32Array[]} places poses of all joints, as matrices
   * @param {Seven} tool
   * @param {Seven} target
   */
  drawGhost(joints, places, tool, target) {
    const moved = times(matrixOf(target), inverseOf(matrixOf(tool)));
    this.gl.depthMask(false); // shapes behind the gripper stay visible
    for (const { mesh, joint } of this.robot)
      if (joints.includes(joint)) this.shape(mesh, WORLD, times(moved, places[joint]), GHOST, GHOST_OPACITY);
    this.gl.depthMask(true);
  }

  /**
   * @param {Mesh} mesh
   * @param {Float32Array} space matrix of the pose of the frame in which `place` is given, in the operator's room
   * @param {Float32Array} place matrix of the shape's pose and size
   * @param {number[]} colour
   */
  shape(mesh, space, place, colour, opacity = 1) {
    const [red, green, blue] = colour;
    this.gl.uniform4f(this.shapes.colour, red, green, blue, opacity);
    this.show(this.shapes, mesh, times(space, place));
  }

  /**
   * @param {Program} program
   * @param {Mesh} mesh
   * @param {Float32Array} model
   */
  show(program, mesh, model) {
    const { gl } = this;
    gl.uniformMatrix4fv(program.model, false, model);
    gl.bindVertexArray(mesh.array);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
  }
}

/**
 * The distance of a target from its tool [m].
 * @param {Seven} tool
 * @param {Seven} target
 */
const leashOf = (tool, target) => Math.hypot(target[0] - tool[0], target[1] - tool[1], target[2] - tool[2]);
