// Reader of bundles (docs/concepts/bundle.md), which decodes the data as they arrive.

import type { LevelSet } from "../../client/src/body_shadows";
import type { MainLight } from "../../client/src/packets";
import type { Embedding, SplatData } from "../../client/src/splats";

export interface Camera {
  position: [number, number, number];
  forward: [number, number, number];
  /** Vertical field of view, degrees. */
  fov: number;
}

/** Properties in the JSON text of a bundle. */
export interface Facts {
  title?: string;
  licence?: string;
  up: [number, number, number];
  metres_per_unit: number;
  rate: number;
  frames: number;
  height?: number;
  flat_ground?: boolean;
  camera?: Camera;
  /** Main light of the capture, in the axes of the bundle. */
  light?: MainLight;
}

export interface BundleCage {
  rest: Float32Array;
  tets: Int32Array;
  /** Node indices of the triangles of the cage's surface. */
  surface: Int32Array;
  embedding: Embedding;
  /** Level set at rest and height of the body, from which its contact shadows on other bodies are computed. */
  shape?: { levelSet: LevelSet; height: number } | undefined;
  /** Node positions of the frames that have arrived. */
  frames: Float32Array[];
}

export interface BundleBody {
  name: string;
  antialiased: boolean;
  splats: SplatData;
  /** Normals of the splats at rest, as bytes 128 + 127 n. */
  normals?: Uint8Array | undefined;
  /** Cage that moves the splats; undefined for static splats. */
  cage?: BundleCage;
}

export interface Bundle {
  facts: Facts;
  bodies: BundleBody[];
  /** Number of frames that have arrived for all bodies. */
  readonly available: number;
  /** Promise that resolves when the whole bundle has arrived, and rejects if the bundle cannot be read to its end. */
  complete: Promise<void>;
}

interface Entry {
  type: keyof typeof TYPES;
  shape: number[];
  offset: number;
  bytes: number;
  lower?: number[];
  step?: number[] | undefined;
}

type Entries = Record<string, Entry>;

interface BodyText {
  name: string;
  count: number;
  degree: number;
  antialiased: boolean;
  max_stretch?: number;
  node_step?: number;
  level_set?: { origin: number[]; spacing: number; counts: number[]; height: number };
  arrays: Entries;
  blocks?: { first: number; frames: number; arrays: Entries }[];
}

type Stored = Uint8Array | Uint16Array | Uint32Array | Float32Array;
type Arrays = Map<string, Stored | Float32Array>;

const TYPES = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array } as const;
const MAGIC = "EGSB";
const VERSION = 2;
const HEAD_BYTES = 12;
/** Kinds of carriers that move splats; see the specification of bundles. */
const TET = 0;
const RIGID = 2;
/** Value of a splat's first share by which deform.glsl.ts recognises that the splat moves rigidly. */
const RIGID_SHARE = 3;
/** Number of steps of `bandScales`. */
const BAND_STEPS = 127;

/** Read a bundle from an address; resolves when its first block has arrived. */
export async function loadBundle(address: string): Promise<Bundle> {
  const response = await fetch(address);
  if (!response.ok || response.body === null) throw new Error(`${address} cannot be read (${response.status})`);
  return readBundle(response.body);
}

/** Read a bundle from a stream; resolves when its first block has arrived. */
export async function readBundle(stream: ReadableStream<Uint8Array>): Promise<Bundle> {
  const source = new ByteSource(stream);
  const head = await source.take(HEAD_BYTES);
  const view = new DataView(head.buffer, head.byteOffset, head.byteLength);
  if (new TextDecoder().decode(head.subarray(0, 4)) !== MAGIC) throw new Error("this file is not a bundle of egs_warp");
  const version = view.getUint32(4, true);
  if (version !== VERSION) throw new Error(`this player reads bundles of version ${VERSION}, not ${version}`);
  const text = new TextDecoder().decode(await source.take(view.getUint32(8, true)));
  const { bodies: bodyTexts, ...facts } = JSON.parse(text) as Facts & { bodies: BodyText[] };
  source.begin();

  const read = async (entries: Entries): Promise<Arrays> => {
    const arrays: Arrays = new Map();
    for (const [name, entry] of byOffset(entries)) {
      // Keep bands and normals in their stored form, which the shader reads.
      const isStored = name === "bands" || name === "normals";
      arrays.set(name, await numbersOf(source, isStored ? { ...entry, step: undefined } : entry));
    }
    return arrays;
  };
  const bodies: BundleBody[] = [];
  const moving: { cage: BundleCage; track: Track; text: BodyText }[] = [];
  for (const text of bodyTexts) {
    const arrays = await read(text.arrays);
    const body = bodyOf(text, arrays);
    bodies.push(body);
    if (body.cage !== undefined) moving.push({ cage: body.cage, track: new Track(arrays, text.node_step ?? 1), text });
  }
  const readBlocks = async (number: number): Promise<void> => {
    for (const { cage, track, text: body } of moving) {
      const block = body.blocks?.[number];
      if (block !== undefined) cage.frames.push(...track.framesOf(arrayOf(await read(block.arrays), "residuals")));
    }
  };
  await readBlocks(0);
  const count = Math.max(1, ...bodyTexts.map((body) => body.blocks?.length ?? 0));
  const rest = async (): Promise<void> => {
    for (let number = 1; number < count; number++) await readBlocks(number);
  };
  const complete = rest();
  // Callers that use the promise still receive its error.
  complete.catch(() => {});
  return {
    facts,
    bodies,
    get available(): number {
      return moving.length === 0 ? facts.frames : Math.min(...moving.map(({ cage }) => cage.frames.length));
    },
    complete,
  };
}

/** Bytes of a stream, in order. */
class ByteSource {
  private readonly reader: ReadableStreamDefaultReader<Uint8Array>;
  private chunks: Uint8Array[] = [];
  private buffered = 0;
  /** Position of the next byte in the data. */
  private position = 0;

  constructor(stream: ReadableStream<Uint8Array>) {
    this.reader = stream.getReader();
  }

  /** Set the position of the next byte to 0. */
  begin(): void {
    this.position = 0;
  }

  /** Return `length` bytes at a position of the data; the position must not be before the next byte. */
  async takeAt(position: number, length: number): Promise<Uint8Array<ArrayBuffer>> {
    if (position < this.position) throw new Error("the arrays of this bundle are not in the order of their offsets");
    if (position > this.position) await this.take(position - this.position);
    return this.take(length);
  }

  async take(length: number): Promise<Uint8Array<ArrayBuffer>> {
    while (this.buffered < length) {
      const { done, value } = await this.reader.read();
      if (done) throw new Error("this bundle is incomplete");
      this.chunks.push(value);
      this.buffered += value.length;
    }
    const result = new Uint8Array(length);
    let filled = 0;
    while (filled < length) {
      const chunk = this.chunks[0]!;
      const part = chunk.subarray(0, length - filled);
      result.set(part, filled);
      filled += part.length;
      if (part.length === chunk.length) this.chunks.shift();
      else this.chunks[0] = chunk.subarray(part.length);
    }
    this.buffered -= length;
    this.position += length;
    return result;
  }
}

function byOffset(entries: Entries): [string, Entry][] {
  return Object.entries(entries).sort(([, a], [, b]) => a.offset - b.offset);
}

/** Read the numbers of an array. */
async function numbersOf(source: ByteSource, entry: Entry): Promise<Stored | Float32Array> {
  const packed = await source.takeAt(entry.offset, entry.bytes);
  const inflated = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(inflated).arrayBuffer());
  const [count = 0, ...others] = entry.shape;
  const components = others.reduce((product, side) => product * side, 1);
  const stored = new TYPES[entry.type](count * components);
  if (planes.length !== stored.byteLength) throw new Error("an array of this bundle has the wrong length");
  const bytes = new Uint8Array(stored.buffer);
  const rowBytes = components * stored.BYTES_PER_ELEMENT;
  for (let plane = 0; plane < rowBytes; plane++) {
    for (let k = 0; k < count; k++) bytes[k * rowBytes + plane] = planes[plane * count + k]!;
  }
  const { lower, step } = entry;
  if (lower === undefined || step === undefined) return stored;
  const numbers = new Float32Array(stored.length);
  for (let k = 0; k < stored.length; k++) {
    numbers[k] = lower[k % lower.length]! + step[k % step.length]! * stored[k]!;
  }
  return numbers;
}

function bodyOf(text: BodyText, arrays: Arrays): BundleBody {
  const splats: SplatData = {
    means: floats(arrays, "means"),
    rotations: quaternions(floats(arrays, "rotations")),
    scales: floats(arrays, "log_scales").map(Math.exp),
    opacities: floats(arrays, "opacities"),
    colours: floats(arrays, "colours"),
    degree: text.degree,
    ...bandsOf(text, arrays),
  };
  const { name, antialiased } = text;
  if (text.blocks === undefined) return { name, antialiased, splats };
  const cage: BundleCage = {
    rest: floats(arrays, "rest_nodes"),
    tets: Int32Array.from(arrayOf(arrays, "cage_tets")),
    surface: Int32Array.from(arrayOf(arrays, "surface")),
    embedding: embeddingOf(arrays, splats, text.max_stretch ?? 1),
    shape: shapeOf(text, arrays),
    frames: [],
  };
  const normals = arrays.get("normals");
  return { name, antialiased, splats, cage, normals: normals instanceof Uint8Array ? normals : undefined };
}

function shapeOf({ level_set: entry }: BodyText, arrays: Arrays): BundleCage["shape"] {
  if (entry === undefined) return undefined;
  const { height, ...lattice } = entry;
  return { height, levelSet: { ...lattice, coefficients: floats(arrays, "level_set") } };
}

function embeddingOf(arrays: Arrays, { scales }: SplatData, maxStretch: number): Embedding {
  const [tets, carriers, ends] = [arrayOf(arrays, "tets"), arrayOf(arrays, "carriers"), arrayOf(arrays, "arm_tets")];
  const shares = floats(arrays, "arm_shares");
  const lengths = floats(arrays, "arm_lengths");
  const bulges = floats(arrays, "arm_bulges");
  const meanTets = new Int32Array(tets.length);
  const modulus = 2 ** (8 * ends.BYTES_PER_ELEMENT);
  let armCount = 0;
  for (const carrier of carriers) armCount += Number(carrier !== TET);
  const arms = new Float32Array(15 * armCount);
  let [row, out] = [0, 0];
  for (let i = 0; i < tets.length; i++) {
    const tet = tets[i]!;
    meanTets[i] = carriers[i] === TET ? tet : -1 - tet;
    if (carriers[i] === TET) continue;
    if (carriers[i] === RIGID) arms[out + 6] = RIGID_SHARE;
    else {
      for (let k = 0; k < 6; k++) {
        const length = lengths[6 * row + k]! * scales[3 * i + (k % 3)]!;
        arms[out + k] = (ends[6 * row + k]! + tet) % modulus;
        arms[out + 6 + k] = length > 0 ? -length : shares[6 * row + k]!;
      }
      for (let k = 0; k < 3; k++) arms[out + 12 + k] = bulges[3 * row + k]! * scales[3 * i + k]!;
      row++;
    }
    out += 15;
  }
  return { meanTets, arms, maxStretch };
}

/** Return the SH bands above 0 with all colours of a coefficient side by side, and their scales. */
function bandsOf(text: BodyText, arrays: Arrays): { bands: Uint8Array; bandScales: Float32Array } {
  const coefficients = (text.degree + 1) ** 2 - 1;
  const bands = new Uint8Array(3 * coefficients * text.count);
  if (coefficients === 0) return { bands, bandScales: new Float32Array(0) };
  const stored = arrayOf(arrays, "bands");
  const bandScales = Float32Array.from(text.arrays.bands!.step!, (step) => BAND_STEPS * step);
  for (let i = 0; i < text.count; i++) {
    for (let c = 0; c < 3; c++) {
      for (let k = 0; k < coefficients; k++) {
        bands[3 * (i * coefficients + k) + c] = stored[(3 * i + c) * coefficients + k]!;
      }
    }
  }
  return { bands, bandScales };
}

/** Return the quaternions w, x, y, z of rotation vectors (axis times angle). */
function quaternions(vectors: Float32Array): Float32Array {
  const result = new Float32Array((4 * vectors.length) / 3);
  for (let i = 0; i < vectors.length / 3; i++) {
    const [x, y, z] = vectors.subarray(3 * i, 3 * i + 3) as unknown as [number, number, number];
    const angle = Math.hypot(x, y, z);
    const factor = angle > 0 ? Math.sin(0.5 * angle) / angle : 0.5;
    result.set([Math.cos(0.5 * angle), factor * x, factor * y, factor * z], 4 * i);
  }
  return result;
}

/** Positions of the nodes of a body, decoded block by block. */
class Track {
  private readonly order: Stored | Float32Array;
  private readonly parents: Stored | Float32Array;
  private readonly weights: Float32Array;
  /** Positions of the nodes in the last frame that was decoded, in steps. */
  private readonly last: Float64Array;

  constructor(
    arrays: Arrays,
    private readonly step: number,
  ) {
    this.order = arrayOf(arrays, "order");
    this.parents = arrayOf(arrays, "parents");
    this.weights = floats(arrays, "weights");
    this.last = Float64Array.from(floats(arrays, "rest_nodes"), (x) => Math.floor(x / step + 0.5));
  }

  /** Return the node positions of the frames of a block. */
  framesOf(residuals: Stored | Float32Array): Float32Array[] {
    const count = this.order.length;
    const width = this.weights.length / count;
    // Displacements of the nodes from the frame before, in steps; by position in the order.
    const moved = new Float64Array(3 * count);
    return Array.from({ length: residuals.length / (3 * count) }, (_, frame) => {
      for (let k = 0; k < count; k++) {
        for (let axis = 0; axis < 3; axis++) {
          let sum = 0.5;
          for (let p = 0; p < width; p++) {
            sum += this.weights[k * width + p]! * moved[3 * this.parents[k * width + p]! + axis]!;
          }
          const stored = residuals[3 * (frame * count + k) + axis]!;
          const displacement = Math.floor(sum) + (stored % 2 === 1 ? -(stored + 1) / 2 : stored / 2);
          moved[3 * k + axis] = displacement;
          this.last[3 * this.order[k]! + axis]! += displacement;
        }
      }
      return Float32Array.from(this.last, (x) => this.step * x);
    });
  }
}

function arrayOf(arrays: Arrays, name: string): Stored {
  const values = arrays.get(name);
  if (values === undefined) throw new Error(`the bundle has no ${name}`);
  return values;
}

function floats(arrays: Arrays, name: string): Float32Array {
  const values = arrayOf(arrays, name);
  return values instanceof Float32Array ? values : Float32Array.from(values);
}
