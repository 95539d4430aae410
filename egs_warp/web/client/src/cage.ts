// Affine map of each cage tetrahedron in a frame (Eq. 14), stored in a texture for the splat shader.

import * as THREE from "three";

export const TEXTURE_WIDTH = 2048;

/** Create a float texture with at least `count` RGBA texels, filled row by row. */
export function floatTexture(count: number): { texture: THREE.DataTexture; values: Float32Array } {
  const rows = Math.max(1, Math.ceil(count / TEXTURE_WIDTH));
  const values = new Float32Array(4 * TEXTURE_WIDTH * rows);
  const texture = new THREE.DataTexture(values, TEXTURE_WIDTH, rows, THREE.RGBAFormat, THREE.FloatType);
  texture.needsUpdate = true;
  return { texture, values };
}

export class Cage {
  /** Maps in four texels per tetrahedron: three rows of F, each followed by one coordinate of x0', and then x0
   * followed by the index of the body, or -1 (`setBody`). */
  readonly texture: THREE.DataTexture;
  private readonly maps: Float32Array;
  private readonly inverses: Float64Array;

  constructor(
    rest: Float32Array,
    private readonly tets: Int32Array,
  ) {
    const count = tets.length / 4;
    const { texture, values } = floatTexture(4 * count);
    this.texture = texture;
    this.maps = values;
    this.inverses = new Float64Array(9 * count);
    for (let t = 0; t < count; t++) {
      const m = edges(rest, tets, t);
      const [a, b, c, d, e, f, g, h, i] = m;
      const [A, B, C] = [e * i - f * h, f * g - d * i, d * h - e * g];
      const determinant = a * A + b * B + c * C;
      const inverse = [
        ...[A, c * h - b * i, b * f - c * e],
        ...[B, a * i - c * g, c * d - a * f],
        ...[C, b * g - a * h, a * e - b * d],
      ];
      for (let k = 0; k < 9; k++) this.inverses[9 * t + k] = (inverse[k] as number) / determinant;
      const start = 3 * (tets[4 * t] as number);
      for (let k = 0; k < 3; k++) this.maps[16 * t + 12 + k] = rest[start + k] as number;
      this.maps[16 * t + 15] = -1;
    }
    this.update(rest);
  }

  /** Set the index of the body to which `count` tetrahedra from `first` on belong. */
  setBody(first: number, count: number, body: number): void {
    for (let t = first; t < first + count; t++) this.maps[16 * t + 15] = body;
  }

  /** Compute the maps for node `positions`. */
  update(positions: Float32Array): void {
    const { maps, inverses, tets } = this;
    for (let t = 0; t < tets.length / 4; t++) {
      const m = edges(positions, tets, t);
      const start = 3 * (tets[4 * t] as number);
      for (let row = 0; row < 3; row++) {
        const out = 16 * t + 4 * row;
        for (let column = 0; column < 3; column++) {
          let sum = 0;
          for (let k = 0; k < 3; k++) sum += (m[3 * row + k] as number) * (inverses[9 * t + 3 * k + column] as number);
          maps[out + column] = sum;
        }
        maps[out + 3] = positions[start + row] as number;
      }
    }
    this.texture.needsUpdate = true;
  }
}

type Nine = [number, number, number, number, number, number, number, number, number];

/** Return the matrix with the columns x1 - x0, x2 - x0 and x3 - x0, row by row. */
function edges(points: Float32Array, tets: Int32Array, t: number): Nine {
  const at = (corner: number, axis: number): number => points[3 * (tets[4 * t + corner] as number) + axis] as number;
  const m: number[] = [];
  for (let axis = 0; axis < 3; axis++) {
    for (let corner = 1; corner < 4; corner++) m.push(at(corner, axis) - at(0, axis));
  }
  return m as Nine;
}

/** Create the texture of one undeformed tetrahedron, so that the same shader draws the static background. */
export function identityCage(): THREE.DataTexture {
  const { texture, values } = floatTexture(4);
  values.set([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0]);
  return texture;
}
