// Computes the pose of the board, which is above the direction in which the operator looks. The board rests while the
// head turns a little, and follows a larger turn.

export const [BOARD_WIDTH, BOARD_DISTANCE] = [1.3, 1.5]; // width of the board, and its distance from the head [m]
const ABOVE = 0.35; // angle of the board above the direction in which the operator looks [rad]
const [LOWEST, HIGHEST] = [-0.3, 0.8]; // least and greatest elevation of the board [rad]
const [FAR, NEAR] = [0.35, 0.03]; // the board begins to follow at the first angle, and stops at the second angle [rad]
const SHARE = 0.08; // share of the remaining angle by which the board turns in a frame

/** @param {number} angle [rad]; the result is the same angle between -pi and pi */
const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

export class Board {
  constructor() {
    this.known = false; // whether a pose of the head has come
    this.yaw = 0; // direction of the board about the vertical, from forward to the right [rad]
    this.pitch = 0; // elevation of the board [rad]
    this.glides = false; // whether the board follows the head now
    /** @type {number[]} */
    this.eye = [0, 0, 0];
  }

  /** @param {ArrayLike<number>} head matrix of the operator's head */
  lookFrom(head) {
    this.eye = [head[12], head[13], head[14]];
    const yaw = Math.atan2(-head[8], head[10]);
    const pitch = Math.min(Math.max(Math.asin(Math.max(Math.min(-head[9], 1), -1)) + ABOVE, LOWEST), HIGHEST);
    const [right, up] = [wrapped(yaw - this.yaw), pitch - this.pitch];
    const away = Math.hypot(right, up);
    if (!this.known) [this.yaw, this.pitch, this.known] = [yaw, pitch, true];
    else if (away > FAR) this.glides = true;
    if (away < NEAR) this.glides = false;
    if (this.glides) {
      this.yaw = wrapped(this.yaw + SHARE * right);
      this.pitch += SHARE * up;
    }
  }

  /**
   * Return the matrix that turns a square with corners from -1 to 1 into the board, which faces the operator.
   * @param {number} aspect height of the board's picture divided by its width
   */
  place(aspect) {
    const [sin, cos] = [Math.sin(this.yaw), Math.cos(this.yaw)];
    const [rise, level] = [Math.sin(this.pitch), Math.cos(this.pitch)];
    const way = [level * sin, rise, -level * cos];
    const half = BOARD_WIDTH / 2;
    const high = half * aspect;
    return new Float32Array([
      half * cos, 0, half * sin, 0,
      -high * rise * sin, high * level, high * rise * cos, 0,
      -way[0], -way[1], -way[2], 0,
      ...way.map((value, axis) => this.eye[axis] + BOARD_DISTANCE * value), 1,
    ]);
  }
}
