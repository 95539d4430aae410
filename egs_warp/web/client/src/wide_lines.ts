// Lines whose width in pixels may change every frame, with a dark rim that separates them from any background.

import * as THREE from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";

/** Width of the rim on each side of a line, pixels, and the rim's colour and opacity. */
const RIM_WIDTH = 1.25;
const RIM_COLOUR = 0x14181f;
const RIM_OPACITY = 0.7;

export class WideLines {
  readonly object = new THREE.Group();
  private readonly parts: LineSegments2[];
  private geometry = new LineSegmentsGeometry();
  private positions = new Float32Array(0);
  private colours = new Float32Array(0);

  constructor(width: number, opacity: number, order: number, { hasRim = true } = {}) {
    const shared = { transparent: true, depthTest: false, depthWrite: false };
    const lines = new LineMaterial({ ...shared, linewidth: width, vertexColors: true, opacity });
    const rim = { linewidth: width + 2 * RIM_WIDTH, color: RIM_COLOUR, opacity: RIM_OPACITY * opacity };
    const materials = hasRim ? [new LineMaterial({ ...shared, ...rim }), lines] : [lines];
    this.parts = materials.map((material, k) => {
      const part = new LineSegments2(this.geometry, material);
      part.frustumCulled = false;
      // Draw the rims of all lines below all lines of the same order.
      part.renderOrder = order + 0.1 * k;
      return part;
    });
    this.object.add(...this.parts);
  }

  /** Set the segments: six coordinates and six colour values each. */
  set(positions: ArrayLike<number>, colours: ArrayLike<number>): void {
    if (positions.length > this.positions.length) {
      this.geometry.dispose();
      this.geometry = new LineSegmentsGeometry();
      this.positions = new Float32Array(Math.max(2 * positions.length, 600));
      this.colours = new Float32Array(this.positions.length);
      this.geometry.setPositions(this.positions);
      this.geometry.setColors(this.colours);
      for (const part of this.parts) part.geometry = this.geometry;
    }
    this.geometry.instanceCount = positions.length / 6;
    if (positions.length === 0) return;
    // setPositions stores a reference to its array.
    write(this.geometry.getAttribute("instanceStart"), positions);
    write(this.geometry.getAttribute("instanceColorStart"), colours);
  }

  dispose(): void {
    this.geometry.dispose();
    for (const part of this.parts) part.material.dispose();
  }
}

function write(attribute: THREE.BufferAttribute | THREE.InterleavedBufferAttribute, values: ArrayLike<number>): void {
  const buffer = (attribute as THREE.InterleavedBufferAttribute).data;
  (buffer.array as Float32Array).set(values);
  buffer.needsUpdate = true;
}
