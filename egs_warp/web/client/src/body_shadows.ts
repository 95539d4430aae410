// Contact shadows of bodies on each other: which bodies are close to each other, and the data from which the shader
// evaluates their level sets in the current pose (docs/concepts/bodies.md#shadows).

import * as THREE from "three";
import occlusion from "../../../contact/occlusion.json";
import { floatTexture, TEXTURE_WIDTH, type Cage } from "./cage";
import { OCCLUDER_TEXELS } from "./occlusion.glsl";

/** Cells along each axis of the grid that assigns a tetrahedron to each point near a body of several tetrahedra. */
const CELLS = 12;
/** Passes over the grid in each direction, in which each cell takes over the tetrahedra of its neighbours. */
const SWEEPS = 2;

/** Level set of a body at rest: a triquadratic B-spline over a cubic lattice (egs_warp/meshing/level_set.py). */
export interface LevelSet {
  origin: number[];
  spacing: number;
  /** Number of nodes along each axis; the last axis of the coefficients varies fastest. */
  counts: number[];
  coefficients: Float32Array;
}

/** Shape of a body that casts contact shadows on other bodies. */
export interface Shape {
  /** Nodes of the surface. */
  outline: Int32Array;
  /** First tetrahedron and number of tetrahedra. */
  tets: [number, number];
  levelSet: LevelSet;
  height: number;
}

/** Return the nodes from `first` on, `count` in number, that are corners of the triangles of a `surface`. */
export function outlineOf(surface: Int32Array, first: number, count: number): Int32Array {
  return Int32Array.from(new Set(surface.filter((node) => node >= first && node < first + count)));
}

export class BodyShadows {
  /** For each body: corners of its box with the decay length; corner, cells per axis, cell size and first cell of its
   * grid; lattice of its level set; first entry and length of its list. Then, for each body, the list of the bodies
   * that shade it. */
  readonly table: THREE.DataTexture;
  /** Tetrahedron of each cell of the grids. */
  readonly seeds: THREE.DataTexture;
  /** Coefficients of the level sets. */
  readonly levels: THREE.DataTexture;
  readonly cage: THREE.DataTexture;
  private readonly rows: Float32Array;
  private readonly tetOfCell: Float32Array;
  /** First cell of the grid of each body. */
  private readonly firstCells: number[];
  private readonly boxes: THREE.Box3[];
  /** First corner and inverse of the edges of each tetrahedron (`placeSeeds`). */
  private readonly frames: Float64Array;
  private readonly leastWeights = new Float32Array(CELLS ** 3);

  /** `shapes` have indices of the nodes and tetrahedra `tets` of the `cage`; `up` is the unit vector upwards. */
  constructor(
    private readonly shapes: Shape[],
    private readonly tets: Int32Array,
    cage: Cage,
    readonly up: THREE.Vector3,
  ) {
    const count = shapes.length;
    const table = floatTexture(count * (OCCLUDER_TEXELS + count));
    this.table = table.texture;
    this.rows = table.values;
    this.boxes = shapes.map(() => new THREE.Box3());
    this.frames = new Float64Array(3 * tets.length);
    this.cage = cage.texture;
    let [cells, coefficients] = [0, 0];
    this.firstCells = [];
    const levels = scalarTexture(shapes.reduce((sum, { levelSet }) => sum + levelSet.coefficients.length, 0));
    shapes.forEach(({ levelSet, height, tets: [first, tetCount] }, body) => {
      cage.setBody(first, tetCount, body);
      levels.values.set(levelSet.coefficients, coefficients);
      const { origin, spacing, counts } = levelSet;
      this.setTexel(body, 4, [...origin, spacing]);
      this.setTexel(body, 5, [...counts, coefficients]);
      this.rows[this.texel(body, 0) + 3] = occlusion.reach * height;
      coefficients += levelSet.coefficients.length;
      this.firstCells.push(cells);
      cells += tetCount > 1 ? CELLS ** 3 : 1;
    });
    const seeds = scalarTexture(cells);
    this.levels = levels.texture;
    this.seeds = seeds.texture;
    this.tetOfCell = seeds.values;
  }

  /** Find the bodies that shade each other at node `positions`. */
  update(positions: Float32Array): void {
    const { shapes, boxes } = this;
    const point = new THREE.Vector3();
    shapes.forEach(({ outline }, body) => {
      const box = boxes[body]!.makeEmpty();
      for (const node of outline) box.expandByPoint(point.fromArray(positions, 3 * node));
    });
    const lists: number[][] = shapes.map(() => []);
    shapes.forEach(({ height }, body) => {
      const box = boxes[body]!.clone().expandByScalar(occlusion.cutoff * occlusion.reach * height);
      const region = new THREE.Box3();
      boxes.forEach((other, k) => {
        if (k === body || !box.intersectsBox(other)) return;
        lists[k]!.push(body);
        region.union(box.clone().intersect(other));
      });
      if (region.isEmpty()) return;
      this.rows.set(box.min.toArray(), this.texel(body, 0));
      this.rows.set(box.max.toArray(), this.texel(body, 1));
      this.placeSeeds(body, region, positions);
    });
    lists.forEach((list, body) => {
      const start = shapes.length * (OCCLUDER_TEXELS + body);
      this.setTexel(body, 6, [start, list.length]);
      list.forEach((other, k) => {
        this.rows[4 * (start + k)] = other;
      });
    });
    this.table.needsUpdate = true;
    this.seeds.needsUpdate = true;
  }

  private texel(body: number, k: number): number {
    return 4 * (OCCLUDER_TEXELS * body + k);
  }

  private setTexel(body: number, k: number, values: number[]): void {
    this.rows.set(values, this.texel(body, k));
  }

  /** Assign to each cell of a grid over `region` the tetrahedron of the body in which the minimum barycentric weight of
   * the cell's centre is largest, or -1 if none is near. A point outside of all tetrahedra moves with the map of this
   * one. */
  private placeSeeds(body: number, region: THREE.Box3, positions: Float32Array): void {
    const [first, count] = this.shapes[body]!.tets;
    const start = this.firstCells[body]!;
    const cells = count > 1 ? CELLS : 1;
    const low = region.min.toArray();
    const size = region.getSize(new THREE.Vector3()).divideScalar(cells).toArray().map((side) => Math.max(side, 1e-9));
    this.setTexel(body, 2, [...low, cells]);
    this.setTexel(body, 3, [...size, start]);
    if (count === 1) {
      this.tetOfCell[start] = first;
      return;
    }
    const { tets, frames } = this;
    const grid = new Grid(this.tetOfCell.subarray(start, start + CELLS ** 3), this.leastWeights, frames, low, size);
    const [lowest, highest] = [
      [0, 0, 0],
      [0, 0, 0],
    ];
    const margin = occlusion.cutoff * this.rows[this.texel(body, 0) + 3]!;
    const edges = new Float64Array(9);
    for (let tet = first; tet < first + count; tet++) {
      const [own, corner] = [12 * tet, 3 * tets[4 * tet]!];
      let isNear = true;
      for (let axis = 0; axis < 3; axis++) {
        const origin = positions[corner + axis]!;
        let [least, most] = [0, 0];
        for (let k = 0; k < 3; k++) {
          const edge = positions[3 * tets[4 * tet + k + 1]! + axis]! - origin;
          edges[3 * k + axis] = edge;
          if (edge < least) least = edge;
          if (edge > most) most = edge;
        }
        const offset = origin - low[axis]!;
        isNear &&= offset + least < CELLS * size[axis]! + margin && offset + most > -margin;
        lowest[axis] = clampedCell((offset + least) / size[axis]!);
        highest[axis] = clampedCell((offset + most) / size[axis]!);
        frames[own + axis] = origin;
      }
      if (!isNear) continue;
      const determinant = invertEdges(edges, frames, own + 3);
      // The shader cannot invert the map of an inverted tetrahedron.
      if (determinant <= 0) continue;
      for (let x = lowest[0]!; x <= highest[0]!; x++) {
        for (let y = lowest[1]!; y <= highest[1]!; y++) {
          for (let z = lowest[2]!; z <= highest[2]!; z++) grid.offer(tet, x, y, z);
        }
      }
    }
    for (let k = 0; k < SWEEPS; k++) grid.sweep();
  }
}

/** Write the inverse of the matrix whose columns are three `edges`, row by row, and return its determinant. */
function invertEdges(edges: Float64Array, inverse: Float64Array, at: number): number {
  const [a, b, c, d, e, f, g, h, i] = edges as unknown as number[];
  const [A, B, C] = [e! * i! - f! * h!, f! * g! - d! * i!, d! * h! - e! * g!];
  const determinant = a! * A + b! * B + c! * C;
  const scale = 1 / determinant;
  inverse[at] = scale * A;
  inverse[at + 1] = scale * B;
  inverse[at + 2] = scale * C;
  inverse[at + 3] = scale * (c! * h! - b! * i!);
  inverse[at + 4] = scale * (a! * i! - c! * g!);
  inverse[at + 5] = scale * (b! * g! - a! * h!);
  inverse[at + 6] = scale * (b! * f! - c! * e!);
  inverse[at + 7] = scale * (c! * d! - a! * f!);
  inverse[at + 8] = scale * (a! * e! - b! * d!);
  return determinant;
}

function clampedCell(place: number): number {
  return Math.min(Math.max(Math.floor(place), 0), CELLS - 1);
}

/** Cells with the tetrahedron in which the minimum barycentric weight of the centre of the cell is largest. */
class Grid {
  constructor(
    /** Tetrahedron of each cell; -1 if it has none yet. */
    private readonly seeds: Float32Array,
    /** Minimum barycentric weight of the centre of each cell in its tetrahedron. */
    private readonly leastWeights: Float32Array,
    /** First corner and inverse of the edges of each tetrahedron, row by row. */
    private readonly frames: Float64Array,
    private readonly low: number[],
    private readonly size: number[],
  ) {
    seeds.fill(-1);
    leastWeights.fill(-Infinity);
  }

  /** Assign a tetrahedron to a cell if its minimum weight is larger than that of the cell's tetrahedron. */
  offer(tet: number, x: number, y: number, z: number): void {
    if (tet < 0) return;
    const { frames: f, low, size } = this;
    const at = 12 * tet;
    const dx = low[0]! + (x + 0.5) * size[0]! - f[at]!;
    const dy = low[1]! + (y + 0.5) * size[1]! - f[at + 1]!;
    const dz = low[2]! + (z + 0.5) * size[2]! - f[at + 2]!;
    const u = f[at + 3]! * dx + f[at + 4]! * dy + f[at + 5]! * dz;
    const v = f[at + 6]! * dx + f[at + 7]! * dy + f[at + 8]! * dz;
    const w = f[at + 9]! * dx + f[at + 10]! * dy + f[at + 11]! * dz;
    const weight = Math.min(u, v, w, 1 - u - v - w);
    const cell = (x * CELLS + y) * CELLS + z;
    if (weight <= this.leastWeights[cell]!) return;
    this.leastWeights[cell] = weight;
    this.seeds[cell] = tet;
  }

  /** Pass on the tetrahedra to the next cells along each axis, and then to the previous cells. */
  sweep(): void {
    const { seeds } = this;
    for (const [border, back] of [
      [0, -1],
      [CELLS - 1, 1],
    ] as const) {
      const sign = -back;
      for (let x = border; x >= 0 && x < CELLS; x += sign) {
        for (let y = border; y >= 0 && y < CELLS; y += sign) {
          for (let z = border; z >= 0 && z < CELLS; z += sign) {
            const cell = (x * CELLS + y) * CELLS + z;
            if (x !== border) this.offer(seeds[cell + back * CELLS * CELLS]!, x, y, z);
            if (y !== border) this.offer(seeds[cell + back * CELLS]!, x, y, z);
            if (z !== border) this.offer(seeds[cell + back]!, x, y, z);
          }
        }
      }
    }
  }
}

/** Create a texture with one number per texel, filled row by row. */
function scalarTexture(count: number): { texture: THREE.DataTexture; values: Float32Array } {
  const rows = Math.max(1, Math.ceil(count / TEXTURE_WIDTH));
  const values = new Float32Array(TEXTURE_WIDTH * rows);
  const texture = new THREE.DataTexture(values, TEXTURE_WIDTH, rows, THREE.RedFormat, THREE.FloatType);
  texture.needsUpdate = true;
  return { texture, values };
}
