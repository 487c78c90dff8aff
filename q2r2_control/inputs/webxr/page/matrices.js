// 4 x 4 matrices for WebGL, whose 16 numbers are listed column by column.

/**
 * Return the matrix product a b.
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 */
export function times(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

/**
 * Return the matrix of a pose x y z qx qy qz qw.
 * @param {Seven} pose
 */
export function matrixOf([px, py, pz, x, y, z, w]) {
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0,
    px, py, pz, 1,
  ]);
}

/**
 * Return the inverse of a pose's matrix.
 * @param {ArrayLike<number>} m
 */
export function inverseOf(m) {
  const back = [0, 1, 2].map((axis) => -(m[4 * axis] * m[12] + m[4 * axis + 1] * m[13] + m[4 * axis + 2] * m[14]));
  return new Float32Array([m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, ...back, 1]);
}

/**
 * Return the matrix that stretches a shape along each axis by a factor.
 * @param {ArrayLike<number>} size the factors along x y z
 */
export const scaleOf = ({ 0: x, 1: y, 2: z }) => new Float32Array([x, 0, 0, 0, 0, y, 0, 0, 0, 0, z, 0, 0, 0, 0, 1]);

/**
 * Return the matrix that turns a cube with edges of 1 into a beam from one point to another.
 * @param {Point} from
 * @param {Point} to
 * @param {number} thickness
 */
export function beamOf(from, to, thickness) {
  const way = to.map((value, axis) => value - from[axis]);
  const length = Math.max(Math.hypot(...way), 1e-6);
  const [x, y, z] = way.map((value) => value / length);
  const side = Math.abs(z) < 0.9 ? [y, -x, 0] : [0, z, -y]; // a direction across the beam
  const scale = thickness / Math.hypot(...side);
  const [a, b, c] = side.map((value) => value * scale);
  const up = [y * c - z * b, z * a - x * c, x * b - y * a];
  const middle = from.map((value, axis) => (value + to[axis]) / 2);
  return new Float32Array([...way, 0, a, b, c, 0, ...up, 0, ...middle, 1]);
}

/**
 * Return the matrix of a camera's perspective projection.
 * @param {number} aspect width of the picture divided by its height
 * @param {number} angle vertical angle of view [rad]
 */
export function projection(aspect, angle) {
  const [near, far, scale] = [0.1, 20, 1 / Math.tan(angle / 2)];
  const depth = [(far + near) / (near - far), (2 * far * near) / (near - far)];
  return new Float32Array([scale / aspect, 0, 0, 0, 0, scale, 0, 0, 0, 0, depth[0], -1, 0, 0, depth[1], 0]);
}
