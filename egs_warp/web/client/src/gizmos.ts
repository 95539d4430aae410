// Markers for user interaction: the goal on the ground, the facing direction, the spring of a pull and the ring of a
// push.

import * as THREE from "three";
import { WideLines } from "./wide_lines";

/** Colour of the marks on the ground, which is light; its components are sRGB values, which the shader writes
 * unchanged. */
const ACCENT = new THREE.Color(0x1c9a7c).convertLinearToSRGB();
const PULL = new THREE.Color(0xffc24a).toArray();

export class Gizmos {
  readonly group = new THREE.Group();
  private readonly goal: THREE.Mesh;
  private readonly facing: THREE.Mesh;
  private readonly spring = new WideLines(2.5, 0.95, 16);
  private readonly ring = new WideLines(3.5, 0.9, 16);

  constructor(private readonly height: number) {
    const square = new THREE.PlaneGeometry(0.32 * height, 0.32 * height);
    this.goal = new THREE.Mesh(square, groundMaterial("abs(length(p) - 0.72) - 0.16", 0.85));
    // Distance field of an arrow head: a triangle with a notch at the back.
    const head = "max(0.45 * (p.x - 0.8) + 0.89 * abs(p.y), 0.85 * (-0.2 - 0.625 * abs(p.y) - p.x))";
    this.facing = new THREE.Mesh(new THREE.PlaneGeometry(0.26 * height, 0.26 * height), groundMaterial(head, 0.75));
    for (const mark of [this.goal, this.facing]) {
      mark.renderOrder = -5;
      mark.position.z = 0.002 * height;
      mark.visible = false;
      this.group.add(mark);
    }
    this.group.add(this.spring.object, this.ring.object);
  }

  showGoal(goal: [number, number] | null): void {
    this.goal.visible = goal !== null;
    if (goal !== null) this.goal.position.set(goal[0], goal[1], this.goal.position.z);
  }

  /** Show an arrow on the ground at the distance `reach` from `centre`. */
  showFacing(centre: THREE.Vector3, [x, y]: [number, number], reach: number): void {
    this.facing.visible = true;
    this.facing.position.set(centre.x + reach * x, centre.y + reach * y, this.facing.position.z);
    this.facing.rotation.z = Math.atan2(y, x);
  }

  /** Show the spring from the grabbed point to the point to which the pointer pulls it, or hide the spring. */
  showSpring(grabbed?: THREE.Vector3, target?: THREE.Vector3): void {
    if (grabbed === undefined || target === undefined) {
      this.spring.set([], []);
      return;
    }
    const ring = circle(target, 0.015 * this.height, new THREE.Vector3(1, 0, 0), new THREE.Vector3(0, 1, 0));
    const points = [...grabbed.toArray(), ...target.toArray(), ...ring];
    this.spring.set(points, points.map((_, k) => PULL[k % 3]!));
  }

  /** Show a ring that faces `camera` and grows around the pushed point as `age` goes from 0 to 1, or hide the ring. */
  showPush(centre?: THREE.Vector3, age = 0, camera?: THREE.Camera): void {
    if (centre === undefined || camera === undefined) {
      this.ring.set([], []);
      return;
    }
    const across = new THREE.Vector3(1, 0, 0).applyQuaternion(camera.quaternion);
    const up = new THREE.Vector3(0, 1, 0).applyQuaternion(camera.quaternion);
    const points = circle(centre, (0.03 + 0.12 * Math.sqrt(age)) * this.height, across, up);
    this.ring.set(points, points.map((_, k) => PULL[k % 3]!));
  }
}

/** Return the line segments of a circle in the plane of two unit vectors. */
function circle(centre: THREE.Vector3, radius: number, first: THREE.Vector3, second: THREE.Vector3): number[] {
  const at = (k: number): number[] => {
    const angle = (Math.PI * k) / 12;
    const point = centre.clone().addScaledVector(first, radius * Math.cos(angle));
    return point.addScaledVector(second, radius * Math.sin(angle)).toArray();
  };
  return Array.from({ length: 24 }, (_, k) => [...at(k), ...at(k + 1)]).flat();
}

/** Create an antialiased material from a signed distance field.
 *
 * `distance` is a GLSL expression of p, with p in [-1, 1]^2 on the square; it is negative inside the shape. */
function groundMaterial(distance: string, opacity: number): THREE.ShaderMaterial {
  return new THREE.ShaderMaterial({
    uniforms: { colour: { value: ACCENT } },
    vertexShader: `varying vec2 p;
      void main() { p = 2.0 * uv - 1.0; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
    fragmentShader: `varying vec2 p; uniform vec3 colour;
      void main() {
        float d = ${distance};
        gl_FragColor = vec4(colour, ${opacity} * clamp(0.5 - d / fwidth(d), 0.0, 1.0));
      }`,
    transparent: true,
    depthWrite: false,
    side: THREE.DoubleSide,
  });
}
