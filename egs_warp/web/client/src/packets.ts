// Binary format of a run: one header, then one packet per frame. egs_warp/web/packets.py writes it.

import { outlineOf, type Shape } from "./body_shadows";
import type { Embedding, SplatData } from "./splats";

/** A body of a world: its parts of the joint nodes and splats, and its line of the report. */
export interface BodyPart {
  name: string;
  /** True for a creature, false for a prop. */
  creature: boolean;
  /** First node and number of nodes. */
  nodes: [number, number];
  /** First splat and number of splats. */
  splats: [number, number];
  /** First tetrahedron and number of tetrahedra. */
  tets: [number, number];
  height: number;
  /** Lattice of the level set; the array `level_sets` contains the coefficients of all bodies. */
  level_set: { origin: number[]; spacing: number; counts: number[] };
  state?: string;
  result?: string;
  audit?: string;
}

export interface Curve {
  name: string;
  /** Index of the body of a world; undefined for a run with one body. */
  body?: number;
  title: string;
  unit: string;
}

export interface FilmCamera {
  position: [number, number, number];
  forward: [number, number, number];
  /** Field of view, degrees. */
  fov: number;
  /** Distance of the point around which the user turns the camera, m; without it, the point is at the depth of the
   * middle of the body. */
  distance?: number;
}

export interface Facts {
  title: string;
  rate: number;
  frames: number;
  height: number;
  weight: number;
  friction: number;
  /** Bodies of a world; undefined for a run with one body. */
  bodies?: BodyPart[];
  /** Horizontal unit vector of the front of the body at rest. */
  front: [number, number];
  /** Middle of the box around all bodies at the start of a live session, to which `camera` belongs, m; undefined for
   * a run, whose first frame shows the start. */
  start?: [number, number, number];
  /** True if the ground is the plane z = 0. */
  flat: boolean;
  curves: Curve[];
  fibres: { name: string; kind: string }[];
  camera: FilmCamera;
  audit: Record<string, number>;
  /** Lines about failed audits of pairs and joints of a world. */
  failures?: string[];
  motion: { name: string; reached?: Record<string, number> }[];
  notes: string[];
  degree: { splats: number; scene: number };
  /** Maximum stretch of an arm of a splat relative to the stretch of the material at its two ends. */
  max_stretch: number;
  /** True if the capture was trained with antialiasing. */
  antialiased: boolean;
  /** Main light of the capture. */
  light?: MainLight;
  /** True for the still capture that is shown while its creature is prepared. */
  preparing?: boolean;
  /** True for a capture in which the user picks objects. */
  picking?: boolean;
  /** Identifier of the session, and limits of its sliders; only for live sessions. */
  session?: string;
  limits?: { friction: [number, number]; sag: [number, number]; style: [number, number] };
  /** Named styles of jumps. */
  styles?: Record<string, Style>;
  /** Names of the motions that need no file; only for live sessions. */
  motions?: string[];
  /** For each creature of a world, or for "" if there is only one: the motions that it cannot perform, with reasons. */
  refusals?: Record<string, Record<string, string>>;
}

export interface MainLight {
  /** Unit vector to the light. */
  direction: [number, number, number];
  /** Half of the angular diameter of the light, degrees. */
  half_angle: number;
  /** Fraction of the displayed brightness of the ground that the shadow removes. */
  shade: number;
  /** Quadratic form of the irradiance, four rows of four numbers. */
  irradiance: number[][];
}

/** Style of a jump; each value multiplies a default value (egs_warp/motions/style.py). */
export interface Style {
  anticipation: number;
  squash: number;
  bounce: number;
  timing: number;
}

export type Numbers = Float32Array | Int32Array | Uint8Array;

export interface Header {
  facts: Facts;
  arrays: Map<string, Numbers>;
}

export interface Frame {
  index: number;
  time: number;
  positions: Float32Array;
  /** Activation of each muscle segment; -127 and 127 are the limits. */
  activations: Int8Array;
  /** Nine numbers per contact: point, normal, force. */
  contacts: Float32Array;
  curves: Float32Array;
  /** True if the creature was put elsewhere before this frame, so that there is no motion from the frame before. */
  isReset?: boolean;
}

const MAGIC = "EGSPAGE1";

interface ArrayEntry {
  type: string;
  shape: number[];
  start: number;
}

/** Read the header at the start of `bytes`; `end` is the offset of the first frame in bytes. */
export function readHeader(bytes: ArrayBuffer): { header: Header; end: number } {
  const dataView = new DataView(bytes);
  const text = new TextDecoder();
  if (bytes.byteLength < 12 || text.decode(new Uint8Array(bytes, 0, 8)) !== MAGIC) {
    throw new Error("this file is not a run of egs_warp");
  }
  const length = dataView.getUint32(8, true);
  const { arrays: entries, bytes: size, ...facts } = JSON.parse(text.decode(new Uint8Array(bytes, 12, length)));
  const base = Math.ceil((12 + length) / 8) * 8;
  const arrays = new Map<string, Numbers>();
  for (const [name, { type, shape, start }] of Object.entries(entries as Record<string, ArrayEntry>)) {
    const count = shape.reduce((product, side) => product * side, 1);
    arrays.set(name, view(type, bytes, base + start, count));
  }
  return { header: { facts: facts as Facts, arrays }, end: base + (size as number) };
}

function view(type: string, bytes: ArrayBuffer, start: number, count: number): Numbers {
  switch (type) {
    case "float32":
      return new Float32Array(bytes, start, count);
    case "int32":
      return new Int32Array(bytes, start, count);
    case "uint8":
      return new Uint8Array(bytes, start, count);
    default:
      throw new Error(`arrays of type ${type} are not supported`);
  }
}

/** Read one frame; its offset `start` must be a multiple of four. */
export function readFrame(bytes: ArrayBuffer, start: number): Frame {
  const words = new Uint32Array(bytes, start, 8);
  const counts = [words[2], words[3], words[4], words[5]] as [number, number, number, number];
  const [nodes, segments, contacts, curves] = counts;
  let at = start + 32;
  const floats = (count: number): Float32Array => {
    const values = new Float32Array(bytes, at, count);
    at += 4 * count;
    return values;
  };
  const positions = floats(3 * nodes);
  const activations = new Int8Array(bytes, at, segments);
  at += 4 * Math.ceil(segments / 4);
  return {
    index: words[0] as number,
    time: new Float32Array(bytes, start + 4, 1)[0] as number,
    positions,
    activations,
    contacts: floats(9 * contacts),
    curves: floats(curves),
  };
}

/** Read all frames of a file, each preceded by its length, from offset `start`. */
export function readFrames(bytes: ArrayBuffer, start: number): Frame[] {
  const dataView = new DataView(bytes);
  const frames: Frame[] = [];
  let at = start;
  while (at + 4 <= bytes.byteLength) {
    const length = dataView.getUint32(at, true);
    if (at + 4 + length > bytes.byteLength) break;
    frames.push(readFrame(bytes, at + 4));
    at += 4 + length;
  }
  return frames;
}

/** Return the splats of a header whose arrays begin with `name`. */
export function splatsOf(header: Header, name: "splats" | "scene"): SplatData {
  return {
    means: floatsOf(header, `${name}_means`),
    rotations: floatsOf(header, `${name}_rotations`),
    scales: floatsOf(header, `${name}_scales`),
    opacities: floatsOf(header, `${name}_opacities`),
    colours: floatsOf(header, `${name}_colours`),
    degree: header.facts.degree[name],
    bands: bytesOf(header, `${name}_bands`),
    bandScales: floatsOf(header, `${name}_band_scales`),
  };
}

export function embeddingOf(header: Header): Embedding {
  const { max_stretch: maxStretch } = header.facts;
  return { meanTets: indicesOf(header, "mean_tets"), arms: floatsOf(header, "arms"), maxStretch };
}

/** Return the shapes of the bodies of a world; empty for a run with one body. */
export function shapesOf(header: Header): Shape[] {
  let start = 0;
  return (header.facts.bodies ?? []).map(({ nodes, tets, height, level_set: lattice }) => {
    const [x, y, z] = lattice.counts as [number, number, number];
    const coefficients = floatsOf(header, "level_sets").subarray(start, start + x * y * z);
    start += coefficients.length;
    const outline = outlineOf(indicesOf(header, "surface"), ...nodes);
    return { outline, tets, height, levelSet: { ...lattice, coefficients } };
  });
}

export function floatsOf(header: Header, name: string): Float32Array {
  const values = header.arrays.get(name);
  if (!(values instanceof Float32Array)) throw new Error(`the run has no ${name}`);
  return values;
}

export function indicesOf(header: Header, name: string): Int32Array {
  const values = header.arrays.get(name);
  if (!(values instanceof Int32Array)) throw new Error(`the run has no ${name}`);
  return values;
}

export function bytesOf(header: Header, name: string): Uint8Array {
  const values = header.arrays.get(name);
  if (!(values instanceof Uint8Array)) throw new Error(`the run has no ${name}`);
  return values;
}
