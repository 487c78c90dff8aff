// Makes shapes. `vertices` has x y z of all vertices one after the other [m]. `faces` has three indices of vertices for
// each triangle.

const [CELLS, CELL] = [12, 0.5]; // number of cells along a side of the floor's grid, and the width of a cell [m]

/**
 * Make a box between two opposite corners.
 * @param {number[]} low the corner with the least x y z
 * @param {number[]} high the corner with the greatest x y z
 */
export function boxOf(low, high) {
  /** @type {number[]} */
  const vertices = [];
  for (let corner = 0; corner < 8; corner++)
    for (let axis = 0; axis < 3; axis++) vertices.push((corner >> axis) & 1 ? high[axis] : low[axis]);
  const faces = [0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4, 2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4, 6, 1, 3, 5, 3, 7, 5];
  return { vertices, faces };
}

/**
 * Make the lines of the floor's grid, as thin boxes.
 * @param {number} floor height [m]
 */
export function gridOf(floor) {
  const [half, thin, top] = [(CELLS * CELL) / 2, 0.002, floor + 0.002];
  /** @type {number[]} */
  const vertices = [];
  /** @type {number[]} */
  const faces = [];
  for (let line = 0; line <= CELLS; line++) {
    const at = line * CELL - half;
    for (const [low, high] of [
      [[at - thin, -half, top - thin], [at + thin, half, top]],
      [[-half, at - thin, top - thin], [half, at + thin, top]],
    ]) {
      const box = boxOf(low, high);
      faces.push(...box.faces.map((corner) => corner + vertices.length / 3));
      vertices.push(...box.vertices);
    }
  }
  return { vertices, faces };
}
