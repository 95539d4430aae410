// Soles of the feet, drawn brighter while they carry load.

import * as THREE from "three";
import { LAYER_COLOURS } from "./layer_colours";
import { indicesOf, type Frame, type Header } from "./packets";
import { WideLines } from "./wide_lines";

const LOADED_COLOUR = new THREE.Color(LAYER_COLOURS.loaded).toArray();
const UNLOADED_COLOUR = new THREE.Color(LAYER_COLOURS.lifted).toArray();
/** Load, in body weights, above which a foot counts as loaded. */
const MIN_LOAD = 1e-3;

export class SoleOverlay {
  readonly group = new THREE.Group();
  private readonly outline = new WideLines(2.5, 0.95, 13);
  private readonly geometry = new THREE.BufferGeometry();
  private readonly footFromNode: Int32Array;
  private readonly soles: number[] = [];
  private readonly edges: [number, number][];
  private readonly colours: Float32Array;
  private readonly load: number[];

  constructor(private readonly header: Header) {
    this.footFromNode = indicesOf(header, "foot_from_node");
    const nodes = this.footFromNode.length;
    this.footFromNode.forEach((foot, node) => {
      if (foot >= 0) this.soles.push(node);
    });
    this.load = Array.from({ length: Math.max(-1, ...this.footFromNode) + 1 }, () => 0);
    const faces = this.soleFaces();
    this.edges = boundaryEdges(faces);
    this.colours = new Float32Array(3 * nodes);
    this.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * nodes), 3));
    this.geometry.setAttribute("color", new THREE.BufferAttribute(this.colours, 3));
    this.geometry.setIndex(faces);
    const material = { vertexColors: true, transparent: true, opacity: 0.35, depthTest: false, side: THREE.DoubleSide };
    const fill = new THREE.Mesh(this.geometry, new THREE.MeshBasicMaterial(material));
    fill.frustumCulled = false;
    fill.renderOrder = 12;
    this.group.add(fill, this.outline.object);
  }

  update(frame: Frame, positions: Float32Array): void {
    this.computeLoads(frame, positions);
    for (const node of this.soles) {
      const colour = (this.load[this.footFromNode[node]!] ?? 0) > MIN_LOAD ? LOADED_COLOUR : UNLOADED_COLOUR;
      this.colours.set(colour, 3 * node);
    }
    const positionAttribute = this.geometry.getAttribute("position") as THREE.BufferAttribute;
    (positionAttribute.array as Float32Array).set(positions);
    positionAttribute.needsUpdate = this.geometry.getAttribute("color").needsUpdate = true;
    const lines: number[] = [];
    const tints: number[] = [];
    for (const edge of this.edges) {
      for (const node of edge) {
        lines.push(...positions.subarray(3 * node, 3 * node + 3));
        tints.push(...this.colours.subarray(3 * node, 3 * node + 3));
      }
    }
    this.outline.set(lines, tints);
  }

  /** Compute the load of each foot in body weights. A contact belongs to the foot with the nearest sole node. */
  private computeLoads(frame: Frame, positions: Float32Array): void {
    this.load.fill(0);
    const { contacts } = frame;
    for (let k = 0; k < contacts.length; k += 9) {
      let [minDistance, foot] = [Infinity, -1];
      for (const node of this.soles) {
        const offset = [0, 1, 2].map((axis) => positions[3 * node + axis]! - contacts[k + axis]!);
        const distance = Math.hypot(...offset);
        if (distance < minDistance) [minDistance, foot] = [distance, this.footFromNode[node]!];
      }
      const normalForce = [0, 1, 2].reduce((sum, axis) => sum + contacts[k + 3 + axis]! * contacts[k + 6 + axis]!, 0);
      if (foot >= 0) this.load[foot]! += normalForce / this.header.facts.weight;
    }
  }

  /** Return the surface triangles whose three nodes all belong to one sole. */
  private soleFaces(): number[] {
    const surface = indicesOf(this.header, "surface");
    const faces: number[] = [];
    for (let k = 0; k < surface.length; k += 3) {
      const corners = [...surface.subarray(k, k + 3)];
      const [a, b, c] = corners.map((node) => this.footFromNode[node]!);
      if (a! >= 0 && a === b && b === c) faces.push(...corners);
    }
    return faces;
  }
}

/** Return the edges that belong to exactly one of the `faces`. */
function boundaryEdges(faces: number[]): [number, number][] {
  const counts = new Map<string, { edge: [number, number]; count: number }>();
  for (let k = 0; k < faces.length; k += 3) {
    for (const [i, j] of [[0, 1], [1, 2], [2, 0]] as const) {
      const [a, b] = [faces[k + i]!, faces[k + j]!];
      const key = a < b ? `${a} ${b}` : `${b} ${a}`;
      const entry = counts.get(key) ?? { edge: [a, b], count: 0 };
      entry.count++;
      counts.set(key, entry);
    }
  }
  return [...counts.values()].filter(({ count }) => count === 1).map(({ edge }) => edge);
}
