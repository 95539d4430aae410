// Shadow of the splats on the ground, straight down or of the main light, in layers by height as in a film
// (egs_warp/render/shadow.py).

import * as THREE from "three";
import { TEXTURE_WIDTH } from "./cage";
import type { MainLight } from "./packets";
// The entries are explained in egs_warp/render/shadow.py.
import settings from "../../../render/shadow.json";

/** Texels of a shadow map per body height, and its largest side, texels. */
const DENSITY = 64;
const MAX_SIDE = 1024;
/** Maximum coverage of one texel by one splat; it is less than that of films, because half floats end at 65504. */
const MAX_COVERAGE = 1e3;

/** Shadow map: the fraction of light that the bodies take at each point of a square on the ground. */
export interface ShadowTexture {
  texture: THREE.Texture;
  /** Centre (x, y) of the square, half of its side length, and body height. */
  region: THREE.Vector4;
  /** Displacement of the shadow, per unit of height over the ground. */
  slope: THREE.Vector2;
}

/** Splats that cast shadows. */
export interface Casters {
  /** One point per splat: `position` is its mean at rest, and `caster` its opacity times the area of its broad side,
   * and its tetrahedron. */
  geometry: THREE.BufferGeometry;
  /** Maps of the tetrahedra (`Cage`). */
  cage: THREE.Texture;
  /** Blur radius that hides single splats, m. */
  grain: number;
}

/** Shadows of the bodies: straight down, and of the main light, whose map is empty without a light. */
export interface Shadows {
  sky: ShadowTexture;
  key: ShadowTexture;
}

interface Layers {
  /** Limits of the heights of the layers, and standard deviations of their blurs, in body heights. */
  low: number[];
  high: number[];
  blur: number[];
  /** Maximum opacity of each layer. */
  opacity: number[];
}

/** Return the layers of the shadow straight down, or of the shadow of `light`. */
function layersOf(light: MainLight | undefined): Layers {
  if (light === undefined) {
    const of = (key: "low" | "high" | "blur" | "opacity"): number[] => settings.layers.map((layer) => layer[key]);
    return { low: of("low"), high: of("high"), blur: of("blur"), opacity: of("opacity") };
  }
  const { cast_edges: edges, cast_heights: heights, penumbra, min_sine: minSine } = settings;
  const width = (penumbra * Math.tan((Math.PI * light.half_angle) / 180)) / Math.max(light.direction[2], minSine);
  const blur = heights.map((height) => width * height);
  return { low: edges.slice(0, -1), high: edges.slice(1), blur, opacity: heights.map(() => 1) };
}

/** Return the displacement of the shadow of `light`, per unit of height over the ground. */
export function slopeOf(light: MainLight | undefined): THREE.Vector2 {
  if (light === undefined) return new THREE.Vector2();
  const [x, y, z] = light.direction;
  return new THREE.Vector2(x, y).divideScalar(Math.max(z, settings.min_sine));
}

export class ShadowMap implements ShadowTexture {
  readonly region: THREE.Vector4;
  readonly slope: THREE.Vector2;
  private readonly side: number;
  private readonly layers: Layers;
  private readonly targets: [THREE.WebGLRenderTarget, THREE.WebGLRenderTarget];
  private readonly camera = new THREE.Camera();
  private readonly stage = new THREE.Scene();
  private points: THREE.Points | undefined;
  private blurs: THREE.Mesh[] = [];
  /** Reach of all blurs together, as a fraction of the side of the map. */
  private margin = 0;

  /** Create an empty map.
   *
   * `half` is half of the side of the map, m; `opacity` is the opacity of full shadow. Without a `light`, the shadow is
   * cast straight down. */
  constructor(
    height: number,
    half: number,
    private readonly opacity: number,
    light?: MainLight,
  ) {
    this.side = Math.min(Math.ceil((2 * DENSITY * half) / height), MAX_SIDE);
    const target = (): THREE.WebGLRenderTarget =>
      new THREE.WebGLRenderTarget(this.side, this.side, { depthBuffer: false, type: THREE.HalfFloatType });
    this.targets = [target(), target()];
    this.region = new THREE.Vector4(0, 0, half, height);
    this.slope = slopeOf(light);
    this.layers = layersOf(light);
  }

  /** Set the splats that cast the shadow. */
  setCasters({ geometry, cage, grain }: Casters): void {
    const { side, layers, opacity } = this;
    const { z: half, w: height } = this.region;
    this.points = new THREE.Points(
      geometry,
      new THREE.ShaderMaterial({
        uniforms: {
          cage: { value: cage },
          slope: { value: this.slope },
          region: { value: this.region },
          low: { value: new THREE.Vector3(...layers.low).multiplyScalar(height) },
          high: { value: new THREE.Vector3(...layers.high).multiplyScalar(height) },
          texels: { value: (0.5 * side) / half },
        },
        vertexShader: `
          attribute vec2 caster; uniform sampler2D cage; uniform vec2 slope; uniform vec4 region;
          uniform vec3 low, high; uniform float texels; varying vec3 coverage;
          vec4 texel(int k) { return texelFetch(cage, ivec2(k % ${TEXTURE_WIDTH}, k / ${TEXTURE_WIDTH}), 0); }
          void main() {
            int row = 4 * int(caster.y);
            vec4 a = texel(row), b = texel(row + 1), c = texel(row + 2), d = vec4(position - texel(row + 3).xyz, 1.0);
            vec3 p = vec3(dot(a, d), dot(b, d), dot(c, d));
            float z = max(p.z, 0.0);
            float amount = min(caster.x * texels * texels, ${MAX_COVERAGE.toFixed(1)});
            coverage = amount * step(low, vec3(z)) * (1.0 - step(high, vec3(z)));
            gl_Position = vec4((p.xy - slope * z - region.xy) / region.z, 0.0, 1.0);
            gl_PointSize = 1.0;
          }`,
        fragmentShader: `varying vec3 coverage; void main() { gl_FragColor = vec4(coverage, 1.0); }`,
        depthTest: false,
        depthWrite: false,
        blending: THREE.CustomBlending,
        blendEquation: THREE.AddEquation,
        blendSrc: THREE.OneFactor,
        blendDst: THREE.OneFactor,
      }),
    );
    this.points.frustumCulled = false;
    const texels = (width: number): number =>
      Math.max((Math.min(width, settings.max_blur * height) * side) / (2 * half), settings.min_blur);
    const grains = layers.blur.map(() => texels(grain));
    const sigmas = layers.blur.map((blur) => texels(blur * height));
    const factors = layers.opacity.map((one, k) => `(1.0 - ${one.toFixed(4)} * total[${k}])`).join(" * ");
    const [first, second] = this.targets.map(({ texture }) => texture) as [THREE.Texture, THREE.Texture];
    const [right, up] = [new THREE.Vector2(1 / side, 0), new THREE.Vector2(0, 1 / side)];
    this.blurs = [
      blurMesh(first, grains, right, "total"),
      blurMesh(second, grains, up, "1.0 - exp(-total)"),
      blurMesh(first, sigmas, right, "total"),
      blurMesh(second, sigmas, up, `vec3(${opacity.toFixed(6)} * (1.0 - ${factors}))`),
    ];
    this.margin = (reachOf(grains) + reachOf(sigmas) + 1) / side;
  }

  get texture(): THREE.Texture {
    return this.targets[0].texture;
  }

  /** Render the map around the shadow of the point `middle`; `positions` are those of the nodes. */
  render(renderer: THREE.WebGLRenderer, positions: Float32Array, middle: THREE.Vector3): void {
    const rise = Math.max(middle.z, 0);
    const [x, y] = [middle.x - this.slope.x * rise, middle.y - this.slope.y * rise];
    this.region.x = x;
    this.region.y = y;
    for (const target of this.targets) {
      target.scissorTest = false;
      renderer.setRenderTarget(target);
      renderer.clear();
    }
    if (this.points === undefined) return;
    this.pass(renderer, this.points, this.targets[0]);
    this.clip(positions);
    this.blurs.forEach((mesh, k) => this.pass(renderer, mesh, this.targets[(k + 1) % 2]!));
  }

  private pass(renderer: THREE.WebGLRenderer, object: THREE.Object3D, target: THREE.WebGLRenderTarget): void {
    this.stage.children = [object];
    renderer.setRenderTarget(target);
    renderer.render(this.stage, this.camera);
  }

  /** Blur only the bounding box of the shadow. */
  private clip(positions: Float32Array): void {
    const { x: cx, y: cy, z: half } = this.region;
    const box = new THREE.Box2();
    const point = new THREE.Vector2();
    for (let k = 0; k < positions.length; k += 3) {
      const rise = Math.max(positions[k + 2]!, 0);
      box.expandByPoint(point.set(positions[k]! - this.slope.x * rise, positions[k + 1]! - this.slope.y * rise));
    }
    const at = (value: number): number => Math.min(Math.max(value, 0), 1);
    const { side } = this;
    const low = [box.min.x - cx, box.min.y - cy].map((d) =>
      Math.floor(side * at(0.5 + (0.5 * d) / half - this.margin)),
    );
    const high = [box.max.x - cx, box.max.y - cy].map((d) =>
      Math.ceil(side * at(0.5 + (0.5 * d) / half + this.margin)),
    );
    for (const target of this.targets) {
      target.scissorTest = true;
      target.scissor.set(low[0]!, low[1]!, high[0]! - low[0]!, high[1]! - low[1]!);
    }
  }
}

function reachOf(sigmas: number[]): number {
  return Math.ceil(settings.blur_reach * Math.max(...sigmas));
}

/** Create a triangle over the whole map that blurs `source` along `step`, each channel with its own standard deviation
 * (texels), and writes the GLSL expression `result` of the blurred `total`. */
function blurMesh(source: THREE.Texture, sigmas: number[], step: THREE.Vector2, result: string): THREE.Mesh {
  const falls = sigmas.map((sigma) => (0.5 / sigma ** 2).toFixed(7)).join(", ");
  const triangle = new THREE.BufferGeometry();
  triangle.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
  const mesh = new THREE.Mesh(
    triangle,
    new THREE.ShaderMaterial({
      uniforms: { source: { value: source }, along: { value: step } },
      vertexShader: `varying vec2 at; void main() { at = 0.5 + 0.5 * position.xy; gl_Position = vec4(position, 1.0); }`,
      fragmentShader: `
        varying vec2 at; uniform sampler2D source; uniform vec2 along;
        void main() {
          vec3 total = textureLod(source, at, 0.0).rgb, weights = vec3(1.0);
          for (int k = 1; k <= ${reachOf(sigmas)}; k++) {
            vec2 d = float(k) * along;
            vec3 weight = exp(-float(k * k) * vec3(${falls}));
            total += weight * (textureLod(source, at + d, 0.0).rgb + textureLod(source, at - d, 0.0).rgb);
            weights += 2.0 * weight;
          }
          total /= weights;
          gl_FragColor = vec4(${result}, 1.0);
        }`,
      depthTest: false,
      depthWrite: false,
    }),
  );
  mesh.frustumCulled = false;
  return mesh;
}
