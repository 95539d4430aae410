// Mechanical quantities that are drawn over the splats: cage, muscles, soles, contacts and centre of mass.

import * as THREE from "three";
import { LAYER_COLOURS } from "./layer_colours";
import { SoleOverlay } from "./sole_overlay";
import { floatsOf, indicesOf, type Frame, type Header } from "./packets";
import { WideLines } from "./wide_lines";

export type Layer = "cage" | "muscles" | "feet" | "contacts" | "path";

type Tint = keyof typeof LAYER_COLOURS;
/** Colours in linear RGB, the space in which three.js blends. */
const COLOURS = Object.fromEntries(
  Object.entries(LAYER_COLOURS).map(([name, hex]) => [name, new THREE.Color(hex).toArray()]),
) as Record<Tint, [number, number, number]>;
const CONE_SIDES = 14;
/** Length of an arrow for a force of one body weight, in body heights. */
const WEIGHT_LENGTH = 0.5;

export class Overlays {
  readonly group = new THREE.Group();
  private readonly lines: Record<Exclude<Layer, "feet">, WideLines> = {
    cage: new WideLines(1, 0.5, 10, { hasRim: false }),
    muscles: new WideLines(2.5, 0.9, 11),
    contacts: new WideLines(3, 1, 14),
    path: new WideLines(2.5, 0.95, 12),
  };
  private readonly cones = new WideLines(1.2, 0.8, 13);
  private readonly centreMarker: THREE.Mesh;
  private readonly points: THREE.Points;
  private readonly feet: SoleOverlay;
  private readonly visible = new Set<Layer>();
  private readonly ends: Float32Array;
  /** Centre of mass of each frame. */
  private path = new WeakMap<Frame, THREE.Vector3>();

  constructor(
    private readonly header: Header,
    private readonly centreOf: (frame: Frame) => THREE.Vector3,
  ) {
    for (const lines of [...Object.values(this.lines), this.cones]) this.group.add(lines.object);
    const height = header.facts.height;
    this.centreMarker = new THREE.Mesh(
      new THREE.SphereGeometry(0.018 * height, 20, 14),
      new THREE.MeshBasicMaterial({ color: LAYER_COLOURS.centre, depthTest: false, transparent: true }),
    );
    this.centreMarker.renderOrder = 14;
    this.points = new THREE.Points(
      new THREE.BufferGeometry(),
      new THREE.PointsMaterial({
        color: LAYER_COLOURS.point,
        size: 9,
        sizeAttenuation: false,
        map: disc(),
        depthTest: false,
        transparent: true,
      }),
    );
    this.points.renderOrder = 15;
    this.points.frustumCulled = false;
    this.feet = new SoleOverlay(header);
    this.group.add(this.centreMarker, this.points, this.feet.group);
    this.ends = new Float32Array(3 * (indicesOf(header, "muscle_end_starts").length - 1));
    this.apply();
  }

  show(layer: Layer, visible: boolean): void {
    if (visible) this.visible.add(layer);
    else this.visible.delete(layer);
    this.apply();
  }

  /** Redraw the visible layers. `positions` may be interpolated; `frame` is the nearest frame. */
  update(frame: Frame, positions: Float32Array, frames: Frame[]): void {
    if (this.visible.has("cage")) this.drawCage(positions);
    if (this.visible.has("muscles")) this.drawMuscles(frame, positions);
    if (this.visible.has("feet")) this.feet.update(frame, positions);
    if (this.visible.has("contacts")) this.drawContacts(frame);
    if (this.visible.has("path")) this.drawPath(frame, frames);
  }

  /** Discard the path of the centre of mass, for example because another body is selected. */
  resetPath(): void {
    this.path = new WeakMap();
  }

  private apply(): void {
    for (const [layer, strokes] of Object.entries(this.lines)) {
      strokes.object.visible = this.visible.has(layer as Layer);
    }
    this.centreMarker.visible = this.visible.has("path");
    this.feet.group.visible = this.visible.has("feet");
    this.points.visible = this.cones.object.visible = this.visible.has("contacts");
  }

  private drawCage(positions: Float32Array): void {
    const edges = indicesOf(this.header, "edges");
    const lines = new Float32Array(3 * edges.length);
    for (let k = 0; k < edges.length; k++) lines.set(positions.subarray(3 * edges[k]!, 3 * edges[k]! + 3), 3 * k);
    this.lines.cage.set(lines, tinted(edges.length, COLOURS.cage));
  }

  private drawMuscles(frame: Frame, positions: Float32Array): void {
    const starts = indicesOf(this.header, "muscle_end_starts");
    const nodes = indicesOf(this.header, "muscle_end_nodes");
    const weights = floatsOf(this.header, "muscle_end_weights");
    this.ends.fill(0);
    for (let end = 0; end + 1 < starts.length; end++) {
      for (let k = starts[end]!; k < starts[end + 1]!; k++) {
        for (let axis = 0; axis < 3; axis++) {
          this.ends[3 * end + axis]! += weights[k]! * positions[3 * nodes[k]! + axis]!;
        }
      }
    }
    const segments = indicesOf(this.header, "muscle_segments");
    const lines = new Float32Array(3 * segments.length);
    const colours = new Float32Array(3 * segments.length);
    for (let k = 0; k < segments.length; k++) {
      lines.set(this.ends.subarray(3 * segments[k]!, 3 * segments[k]! + 3), 3 * k);
      const level = (frame.activations[k >> 1] ?? 0) / 127;
      const towards = level > 0 ? COLOURS.contracts : COLOURS.extends;
      // The exponent makes small activations visible, too.
      const strength = Math.abs(level) ** 0.4;
      for (let c = 0; c < 3; c++) {
        colours[3 * k + c] = COLOURS.relaxed[c]! + strength * (towards[c]! - COLOURS.relaxed[c]!);
      }
    }
    this.lines.muscles.set(lines, colours);
  }

  private drawContacts(frame: Frame): void {
    const { height, weight, friction } = this.header.facts;
    const scale = (WEIGHT_LENGTH * height) / weight;
    const arrows = new SegmentList();
    const cones = new SegmentList();
    const points: number[] = [];
    for (let k = 0; k < frame.contacts.length; k += 9) {
      const [point, normal, force] = [0, 3, 6].map((at) => new THREE.Vector3().fromArray(frame.contacts, k + at)) as [
        THREE.Vector3,
        THREE.Vector3,
        THREE.Vector3,
      ];
      points.push(...point.toArray());
      const normalForce = scale * force.dot(normal);
      if (normalForce < 1e-3 * height) continue;
      arrows.add(point, point.clone().addScaledVector(force, scale), COLOURS.force);
      const side = new THREE.Vector3(Math.abs(normal.x) < 0.9 ? 1 : 0, Math.abs(normal.x) < 0.9 ? 0 : 1, 0);
      side.addScaledVector(normal, -side.dot(normal)).normalize();
      const other = new THREE.Vector3().crossVectors(normal, side);
      const rim = (j: number): THREE.Vector3 => {
        const angle = (2 * Math.PI * j) / CONE_SIDES;
        return point
          .clone()
          .addScaledVector(normal, normalForce)
          .addScaledVector(side, friction * normalForce * Math.cos(angle))
          .addScaledVector(other, friction * normalForce * Math.sin(angle));
      };
      for (let j = 0; j < CONE_SIDES; j++) {
        cones.add(rim(j), rim(j + 1), COLOURS.cone);
        if (j % 3 === 0) cones.add(point, rim(j), COLOURS.cone);
      }
    }
    this.lines.contacts.set(arrows.points, arrows.colours);
    this.cones.set(cones.points, cones.colours);
    this.points.geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  }

  private drawPath(frame: Frame, frames: Frame[]): void {
    const lines = new SegmentList();
    const centres = frames.map((one) => this.path.get(one) ?? this.cacheCentre(one));
    for (let k = 0; k + 1 < centres.length; k++) {
      lines.add(centres[k]!, centres[k + 1]!, frames[k]!.time < frame.time ? COLOURS.past : COLOURS.future);
    }
    this.addPlan(lines);
    const now = this.centreMarker.position.copy(this.centreOf(frame));
    lines.add(now, now.clone().setZ(0), COLOURS.plumb);
    this.lines.path.set(lines.points, lines.colours);
  }

  /** Add the planned path of the centre of mass as a dashed line. */
  private addPlan(lines: SegmentList): void {
    if (!this.header.arrays.has("plan")) return;
    const plan = floatsOf(this.header, "plan");
    const at = (k: number): THREE.Vector3 => new THREE.Vector3().fromArray(plan, 3 * k);
    for (let k = 0; 3 * k + 5 < plan.length; k += 2) {
      if (Number.isFinite(plan[3 * k]) && Number.isFinite(plan[3 * k + 3])) lines.add(at(k), at(k + 1), COLOURS.plan);
    }
  }

  private cacheCentre(frame: Frame): THREE.Vector3 {
    const centre = this.centreOf(frame);
    this.path.set(frame, centre);
    return centre;
  }
}

class SegmentList {
  readonly points: number[] = [];
  readonly colours: number[] = [];

  add(from: THREE.Vector3, to: THREE.Vector3, colour: readonly number[]): void {
    this.points.push(...from.toArray(), ...to.toArray());
    this.colours.push(...colour, ...colour);
  }
}

/** Create the texture of a round dot with a dark rim. */
function disc(): THREE.Texture {
  const side = 32;
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = side;
  const context = canvas.getContext("2d") as CanvasRenderingContext2D;
  for (const [colour, radius] of [["#14181f", side / 2 - 1], ["#fff", 0.32 * side]] as const) {
    context.fillStyle = colour;
    context.beginPath();
    context.arc(side / 2, side / 2, radius, 0, 2 * Math.PI);
    context.fill();
  }
  return new THREE.CanvasTexture(canvas);
}

function tinted(count: number, colour: readonly number[]): Float32Array {
  const colours = new Float32Array(3 * count);
  for (let k = 0; k < colours.length; k++) colours[k] = colour[k % 3]!;
  return colours;
}
