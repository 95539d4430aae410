// Lines with a width in pixels that may change every frame.

import * as THREE from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";

export class WideLines {
  readonly object: LineSegments2;
  private readonly material: LineMaterial;
  private geometry = new LineSegmentsGeometry();
  private positions = new Float32Array(0);
  private colours = new Float32Array(0);

  constructor(width: number, opacity: number, order: number) {
    this.material = new LineMaterial({
      linewidth: width,
      vertexColors: true,
      transparent: true,
      opacity,
      depthTest: false,
      depthWrite: false,
    });
    this.object = new LineSegments2(this.geometry, this.material);
    this.object.frustumCulled = false;
    this.object.renderOrder = order;
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
      this.object.geometry = this.geometry;
    }
    this.geometry.instanceCount = positions.length / 6;
    if (positions.length === 0) return;
    // setPositions stores a reference to its array.
    write(this.geometry.getAttribute("instanceStart"), positions);
    write(this.geometry.getAttribute("instanceColorStart"), colours);
  }

  dispose(): void {
    this.geometry.dispose();
    this.material.dispose();
  }
}

function write(attribute: THREE.BufferAttribute | THREE.InterleavedBufferAttribute, values: ArrayLike<number>): void {
  const buffer = (attribute as THREE.InterleavedBufferAttribute).data;
  (buffer.array as Float32Array).set(values);
  buffer.needsUpdate = true;
}
