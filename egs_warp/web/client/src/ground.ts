// Floor with a grid that turns gradually into a sky, as in the film, and the soft shadow of the creature.

import * as THREE from "three";
import type { MainLight } from "./packets";
// The entries are explained in egs_warp/render/backdrop.py.
import studio from "../../../render/studio.json";
import { SHADOW_GLSL, WIDE_RADIUS } from "./shadow.glsl";

/** Background colour behind a captured scene, and behind the creature if the ground is hidden. */
export const BACKGROUND = 0xb9bec6;
/** Depth below which the floor hides splats, in body heights. Pressed soles extend below the ground by less than
 * this. */
export const FLOOR_DEPTH = 0.015;
/** Side of the shadow map for one body, and the largest side for several bodies, texels. */
const SHADOW_SIDE = 256;
const MAX_SHADOW_SIDE = 2048;
/** Half of the side of the shadow map for one body, in body heights. */
const HALF_SIDE = 1.5;
/** Radius of the contact shadow, as a fraction of the side of the shadow map. */
const SOFTNESS = 0.014;
/** Minimum sine of the elevation of the main light, as in egs_warp/render/shadow.py. */
const MIN_SINE = 0.17;
/** Displacement of the shadow map in the direction of the main light's shadow, as a fraction of the displacement at
 * body height. */
const CAST_SHIFT = 0.4;
/** Maximum displacement of the map, in body heights, at which the body is still on the map. */
const MAX_SHIFT = 0.8;
/** Blending that retains the maximum of each channel. */
const BRIGHTEST = {
  side: THREE.DoubleSide,
  depthTest: false,
  blending: THREE.CustomBlending,
  blendEquation: THREE.MaxEquation,
  blendSrc: THREE.OneFactor,
  blendDst: THREE.OneFactor,
} as const;
/** Floor settings as GLSL literals. */
const LOOK = {
  floor: vec3(studio.floor),
  horizon: vec3(studio.horizon),
  sky: vec3(studio.sky),
  line: vec3(studio.line),
  clear: float(studio.clear),
  hazy: float(studio.hazy),
  minSlope: float(studio.min_slope),
  skyRise: float(studio.sky_rise),
};

export class Ground {
  /** Shadow map and its region on the ground: centre (x, y), half of its side length, and body height. */
  readonly shadow: { texture: THREE.Texture; region: THREE.Vector4 };
  /** Sky and floor, drawn as one triangle behind everything else. */
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  /** The shadow alone, for a floor that is part of the image behind the canvas. */
  readonly shadowMesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  private readonly target: THREE.WebGLRenderTarget;
  private readonly camera: THREE.OrthographicCamera;
  private readonly caster: THREE.Mesh;
  private readonly casters = new THREE.Scene();
  private readonly points: THREE.BufferAttribute;
  /** Side of the shadow map for one body, divided by the side of this shadow map. */
  private readonly spread: number;
  /** Displacement of the main light's shadow, per unit of height over the ground. */
  private readonly slope = new THREE.Vector2();

  /** `extent` is half of the horizontal extent of several bodies, m; the shadow map covers it. */
  constructor(surface: Int32Array, nodeCount: number, height: number, light?: MainLight, extent = 0) {
    const half = HALF_SIDE * height + extent;
    this.spread = (HALF_SIDE * height) / half;
    const side = Math.min(SHADOW_SIDE * 2 ** Math.ceil(-Math.log2(this.spread)), MAX_SHADOW_SIDE);
    this.target = new THREE.WebGLRenderTarget(side, side, {
      depthBuffer: false,
      generateMipmaps: true,
      minFilter: THREE.LinearMipmapLinearFilter,
    });
    const shade = light?.shade ?? 0;
    if (light !== undefined && shade > 0) {
      const [x, y, z] = light.direction;
      this.slope.set(x, y).divideScalar(Math.max(z, MIN_SINE));
    }
    this.shadow = { texture: this.target.texture, region: new THREE.Vector4(0, 0, half, height) };
    this.camera = new THREE.OrthographicCamera(-half, half, half, -half, -100 * height, 100 * height);
    const geometry = new THREE.BufferGeometry();
    this.points = new THREE.BufferAttribute(new Float32Array(3 * nodeCount), 3);
    geometry.setAttribute("position", this.points);
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(surface), 1));
    this.caster = new THREE.Mesh(
      geometry,
      new THREE.ShaderMaterial({
        uniforms: { height: { value: height }, ambient: { value: 1 - shade } },
        vertexShader: `varying float z;
          void main() { z = position.z; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
        fragmentShader: `uniform float height, ambient; varying float z;
          void main() {
            float h = max(z, 0.0) / height;
            gl_FragColor = vec4(ambient / (1.0 + 3.0 * h), ambient * exp(-h / 0.05), 0.0, 1.0);
          }`,
        ...BRIGHTEST,
      }),
    );
    this.caster.frustumCulled = false;
    this.casters.add(this.caster);
    if (shade > 0) {
      const cast = new THREE.Mesh(
        geometry,
        new THREE.ShaderMaterial({
          uniforms: { slope: { value: this.slope }, shade: { value: shade } },
          vertexShader: `uniform vec2 slope; varying vec2 at;
            void main() {
              vec3 p = vec3(position.xy - slope * max(position.z, 0.0), 0.0);
              gl_Position = projectionMatrix * modelViewMatrix * vec4(p, 1.0);
              at = gl_Position.xy;
            }`,
          // The shadow of a high jump ends softly at the edge of the map.
          fragmentShader: `uniform float shade; varying vec2 at;
            void main() {
              float edge = smoothstep(1.0, 0.8, max(abs(at.x), abs(at.y)));
              gl_FragColor = vec4(0.0, 0.0, shade * edge, 1.0);
            }`,
          ...BRIGHTEST,
        }),
      );
      cast.frustumCulled = false;
      this.casters.add(cast);
    }
    const material = new THREE.ShaderMaterial({
      uniforms: {
        shade: { value: this.target.texture },
        shadeCentre: { value: new THREE.Vector2() },
        shadeHalf: { value: half },
        spread: { value: this.spread },
        cell: { value: 0.25 * height },
        box: { value: new THREE.Vector4() },
        viewToWorld: { value: new THREE.Matrix3() },
        eye: { value: new THREE.Vector3() },
        forward: { value: new THREE.Vector3() },
        slope: { value: new THREE.Vector2() },
        middle: { value: new THREE.Vector2() },
      },
      vertexShader: `varying vec3 ray; uniform mat3 viewToWorld; uniform vec2 slope, middle;
        void main() {
          ray = viewToWorld * vec3((position.xy + middle) * slope, -1.0);
          gl_Position = vec4(position.xy, 1.0, 1.0);
        }`,
      fragmentShader: `
        varying vec3 ray; uniform sampler2D shade; uniform vec2 shadeCentre; uniform vec3 eye, forward;
        uniform float shadeHalf, cell, spread; uniform vec4 box;
        ${SHADOW_GLSL}
        /* 1 on the lines of a grid; lines that are only a few pixels apart are faded out. */
        float line(vec2 p, vec2 pixel, float cell) {
          vec2 d = abs(fract(p / cell + 0.5) - 0.5) * cell;
          vec2 l = clamp(1.1 - d / pixel, 0.0, 1.0) * clamp(0.2 * cell / pixel - 1.0, 0.0, 1.0);
          return max(l.x, l.y);
        }
        void main() {
          vec3 to = normalize(ray);
          vec3 colour = mix(${LOOK.horizon}, ${LOOK.sky}, clamp(to.z / ${LOOK.skyRise}, 0.0, 1.0));
          // Compute this also where there is no floor, because derivatives need all pixels of a block.
          vec2 p = eye.xy - to.xy * (eye.z / min(to.z, -1e-6));
          vec2 pixel = max(fwidth(p), 1e-9);
          if (to.z < 0.0 && eye.z > 0.0) {
            float strength = max(0.4 * line(p, pixel, cell), line(p, pixel, 4.0 * cell));
            vec3 ground = mix(${LOOK.floor}, ${LOOK.line}, strength);
            vec2 uv = 0.5 + 0.5 * (p - shadeCentre) / shadeHalf;
            bool inside = all(greaterThan(uv, box.xy)) && all(lessThan(uv, box.zw));
            if (inside) ground *= egsShade(shade, uv, ${SOFTNESS}, spread);
            float middle = eye.z / max(-forward.z, ${LOOK.minSlope}), depth = dot(vec3(p, 0.0) - eye, forward);
            float haze = smoothstep(${LOOK.clear} * middle, ${LOOK.hazy} * middle, depth);
            colour = mix(ground, ${LOOK.horizon}, haze);
          }
          gl_FragColor = vec4(colour, 1.0);
        }`,
      depthTest: false,
      depthWrite: false,
    });
    const triangle = new THREE.BufferGeometry();
    triangle.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
    this.mesh = new THREE.Mesh(triangle, material);
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = -10;
    this.mesh.onBeforeRender = (_renderer, _scene, camera) => {
      const { viewToWorld, eye, forward, slope, middle } = material.uniforms;
      (viewToWorld!.value as THREE.Matrix3).setFromMatrix4(camera.matrixWorld);
      (eye!.value as THREE.Vector3).setFromMatrixPosition(camera.matrixWorld);
      camera.getWorldDirection(forward!.value as THREE.Vector3);
      const projection = camera.projectionMatrix.elements;
      (slope!.value as THREE.Vector2).set(1 / projection[0]!, 1 / projection[5]!);
      // The projection of a headset's eye is not symmetric.
      (middle!.value as THREE.Vector2).set(projection[8]!, projection[9]!);
    };
    this.shadowMesh = new THREE.Mesh(
      new THREE.PlaneGeometry(2 * half, 2 * half),
      new THREE.ShaderMaterial({
        uniforms: { shade: material.uniforms.shade!, box: material.uniforms.box!, spread: { value: this.spread } },
        vertexShader: `varying vec2 at;
          void main() { at = uv; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
        fragmentShader: `varying vec2 at; uniform sampler2D shade; uniform vec4 box; uniform float spread;
          ${SHADOW_GLSL}
          void main() {
            if (any(lessThan(at, box.xy)) || any(greaterThan(at, box.zw))) discard;
            gl_FragColor = vec4(0.0, 0.0, 0.0, 1.0 - egsShade(shade, at, ${SOFTNESS}, spread));
          }`,
        transparent: true,
        depthTest: false,
        depthWrite: false,
      }),
    );
    this.shadowMesh.renderOrder = -10;
    this.shadowMesh.visible = false;
  }

  /** Render the shadow map of the cages at node `positions`, centred at `centreOfMass`. */
  cast(renderer: THREE.WebGLRenderer, positions: Float32Array, centreOfMass: THREE.Vector3): void {
    (this.points.array as Float32Array).set(positions);
    this.points.needsUpdate = true;
    const { uniforms } = this.mesh.material;
    const height = this.shadow.region.w;
    const shift = this.slope.clone().multiplyScalar(CAST_SHIFT).clampLength(0, MAX_SHIFT).multiplyScalar(height);
    const centre = new THREE.Vector2(centreOfMass.x, centreOfMass.y).sub(shift);
    (uniforms.shadeCentre!.value as THREE.Vector2).copy(centre);
    this.updateShadowBox(positions, centre);
    this.camera.position.set(centre.x, centre.y, 0);
    this.shadow.region.x = centre.x;
    this.shadow.region.y = centre.y;
    this.shadowMesh.position.set(centre.x, centre.y, 0);
    const saved = {
      target: renderer.getRenderTarget(),
      colour: renderer.getClearColor(new THREE.Color()),
      alpha: renderer.getClearAlpha(),
      xr: renderer.xr.enabled,
    };
    // With XR enabled, three.js would replace the camera by the headset's.
    renderer.xr.enabled = false;
    renderer.setRenderTarget(this.target);
    renderer.setClearColor(0x000000, 1);
    renderer.clear();
    renderer.render(this.casters, this.camera);
    renderer.setRenderTarget(saved.target);
    renderer.setClearColor(saved.colour, saved.alpha);
    renderer.xr.enabled = saved.xr;
  }

  /** Set the bounding box of the shadow; the shader samples the shadow map only inside it. */
  private updateShadowBox(positions: Float32Array, centre: THREE.Vector2): void {
    let [left, right, near, far] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let k = 0; k < positions.length; k += 3) {
      const rise = Math.max(positions[k + 2]!, 0);
      const [x, y] = [this.slope.x * rise, this.slope.y * rise];
      left = Math.min(left, positions[k]! - Math.max(x, 0));
      right = Math.max(right, positions[k]! - Math.min(x, 0));
      near = Math.min(near, positions[k + 1]! - Math.max(y, 0));
      far = Math.max(far, positions[k + 1]! - Math.min(y, 0));
    }
    const half = this.shadow.region.z;
    const at = (x: number, middle: number): number => 0.5 + (0.5 * (x - middle)) / half;
    // Extend the box by the blur radius and a texel of the coarser level, and clip it to the shadow map.
    const edge = this.spread * (WIDE_RADIUS + 10 / SHADOW_SIDE);
    (this.mesh.material.uniforms.box!.value as THREE.Vector4).set(
      Math.max(at(left, centre.x) - edge, 0),
      Math.max(at(near, centre.y) - edge, 0),
      Math.min(at(right, centre.x) + edge, 1),
      Math.min(at(far, centre.y) + edge, 1),
    );
  }
}

/** Return a GLSL float literal; a number without a decimal point would be an integer. */
function float(value: number): string {
  return Number.isInteger(value) ? value.toFixed(1) : String(value);
}

function vec3(values: number[]): string {
  return `vec3(${values.map(float).join(", ")})`;
}
