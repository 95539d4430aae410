// Floor with a grid that turns gradually into a sky, as in the film, and the soft shadow of the creature.

import * as THREE from "three";
import type { MainLight } from "./packets";
// The entries are explained in egs_warp/render/backdrop.py.
import studio from "../../../render/studio.json";
import { SHADOW_GLSL } from "./shadow.glsl";
import { ShadowMap, slopeOf, type Casters, type Shadows, type ShadowTexture } from "./shadow_map";

const [red, green, blue] = studio.surroundings as [number, number, number];
/** Background colour behind a captured scene, as in a film, and behind the creature if the ground is hidden. */
export const BACKGROUND = new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace).getHex();
/** Depth below which the floor hides splats, in body heights. Pressed soles extend below the ground by less than
 * this. */
export const FLOOR_DEPTH = 0.015;
/** Distance between the bodies and the edges of the shadow maps, in body heights. */
const MARGIN = 1.5;
/** Half of the side of the plane that shows the shadow alone, relative to that of the shadow map. */
const PLANE_SIDE = 3;
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
  readonly shadows: Shadows;
  /** Sky and floor, drawn as one triangle behind everything else. */
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  /** The shadow alone, for a floor that is part of the image behind the canvas. */
  readonly shadowMesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  private readonly maps: ShadowMap[];
  private hasCasters = false;

  /** `radius` is the radius of a ball around the bodies, m; the shadow maps cover it. */
  constructor(height: number, radius: number, light?: MainLight) {
    const half = MARGIN * height + radius;
    const shade = light?.shade ?? 0;
    const sky = new ShadowMap(height, half, 1 - shade);
    this.maps = [sky];
    let key: ShadowTexture = { texture: sky.texture, region: new THREE.Vector4(), slope: new THREE.Vector2() };
    if (light !== undefined && shade > 0) {
      const stretched = half + 0.5 * height * slopeOf(light).length();
      const map = new ShadowMap(height, stretched, shade, light);
      this.maps.push(map);
      key = map;
    }
    this.shadows = { sky, key };
    const shadowUniforms = {
      sky: { value: sky.texture },
      skyRegion: { value: sky.region },
      key: { value: key.texture },
      keyRegion: { value: key.region },
    };
    const shadowDeclarations = `uniform sampler2D sky, key; uniform vec4 skyRegion, keyRegion;
        ${SHADOW_GLSL}
        float lightAt(vec2 p) {
          float light = egsShade(sky, skyRegion, vec2(0.0), vec3(p, 0.0));
          return keyRegion.z > 0.0 ? light * egsShade(key, keyRegion, vec2(0.0), vec3(p, 0.0)) : light;
        }`;
    const material = new THREE.ShaderMaterial({
      uniforms: {
        ...shadowUniforms,
        cell: { value: 0.25 * height },
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
        varying vec3 ray; uniform vec3 eye, forward; uniform float cell;
        ${shadowDeclarations}
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
            vec3 ground = lightAt(p) * mix(${LOOK.floor}, ${LOOK.line}, strength);
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
      new THREE.PlaneGeometry(2 * PLANE_SIDE * half, 2 * PLANE_SIDE * half),
      new THREE.ShaderMaterial({
        uniforms: shadowUniforms,
        vertexShader: `varying vec2 at;
          void main() {
            at = (modelMatrix * vec4(position, 1.0)).xy;
            gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
          }`,
        fragmentShader: `varying vec2 at;
          ${shadowDeclarations}
          void main() { gl_FragColor = vec4(0.0, 0.0, 0.0, 1.0 - lightAt(at)); }`,
        transparent: true,
        depthTest: false,
        depthWrite: false,
      }),
    );
    this.shadowMesh.renderOrder = -10;
    this.shadowMesh.visible = false;
  }

  /** True if the floor or the shadow alone is shown. */
  get isVisible(): boolean {
    return this.mesh.visible || this.shadowMesh.visible;
  }

  /** Set the splats that cast shadows; without them, there is no shadow. */
  setCasters(casters: Casters): void {
    for (const map of this.maps) map.setCasters(casters);
    this.hasCasters = true;
  }

  /** Render the shadow maps of the casters, whose cages have the node `positions`, around the point `middle` of the
   * bodies. */
  cast(renderer: THREE.WebGLRenderer, positions: Float32Array, middle: THREE.Vector3): void {
    if (!this.hasCasters) return;
    this.shadowMesh.position.set(middle.x, middle.y, 0);
    const saved = {
      target: renderer.getRenderTarget(),
      colour: renderer.getClearColor(new THREE.Color()),
      alpha: renderer.getClearAlpha(),
      xr: renderer.xr.enabled,
    };
    // With XR enabled, three.js would replace the camera by the headset's.
    renderer.xr.enabled = false;
    renderer.setClearColor(0x000000, 1);
    for (const map of this.maps) map.render(renderer, positions, middle);
    renderer.setRenderTarget(saved.target);
    renderer.setClearColor(saved.colour, saved.alpha);
    renderer.xr.enabled = saved.xr;
  }
}

/** Return the radius of a ball around the nodes of all bodies, m, in the state in which it is largest. Each state
 * consists of the node positions of each body. */
export function radiusOf(states: Float32Array[][]): number {
  return states.reduce((radius, bodies) => {
    const box = new THREE.Box3();
    for (const positions of bodies) box.union(new THREE.Box3().setFromArray(positions));
    return Math.max(radius, 0.5 * box.getSize(new THREE.Vector3()).length());
  }, 0);
}

/** Return a GLSL float literal; a number without a decimal point would be an integer. */
function float(value: number): string {
  return Number.isInteger(value) ? value.toFixed(1) : String(value);
}

function vec3(values: number[]): string {
  return `vec3(${values.map(float).join(", ")})`;
}
