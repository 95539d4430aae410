// Spark with shaders that use the opacity cut, the low-pass filter and the clipping of egs_warp's renderer
// (docs/concepts/renderer.md). Many splats share one instance, because the cost of an instance hardly depends on its
// size. In a software rasteriser, an instance costs a hundred times as much as one splat.

import { Readback, SparkRenderer, SplatAccumulator } from "@sparkjsdev/spark";
import * as THREE from "three";

const QUADS_PER_INSTANCE = 1024;

/** Geometry with a fixed number of splats per instance. Spark sets the number of splats. */
class QuadBatches extends THREE.InstancedBufferGeometry {
  constructor(count: { value: number }) {
    super();
    const corners = new Float32Array(9 * QUADS_PER_INSTANCE);
    for (let k = 0; k < QUADS_PER_INSTANCE; k++) {
      corners.set([0, 2, k, -Math.sqrt(3), -1, k, Math.sqrt(3), -1, k], 9 * k);
    }
    this.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    Object.defineProperty(this, "instanceCount", {
      get: () => Math.ceil(count.value / QUADS_PER_INSTANCE),
      set: (splats: number) => {
        count.value = splats;
      },
    });
  }
}

const VERTEX = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2D;
precision highp usampler2DArray;
#include <splatDefines>

uniform vec2 renderSize;
uniform vec3 renderToViewPos;
uniform mat3 renderToViewBasis;
uniform usampler2D ordering;
uniform usampler2DArray extSplats;
uniform usampler2DArray extSplats2;
uniform int splatCount;
uniform bool antialiased;
uniform float floorDepth;
out vec2 offsetInSigmas;
flat out vec3 heightOverFloor;
flat out vec4 rgba;

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  int rank = gl_InstanceID * ${QUADS_PER_INSTANCE} + int(position.z);
  if (rank >= splatCount) return;
  uint index = texelFetch(ordering, ivec2((rank >> 2) & 4095, rank >> 14), 0)[rank & 3];
  if (index == 0xffffffffu) return;
  ivec3 texel = splatTexCoord(int(index));
  vec3 mean, squares, products;
  unpackSplatExtCov(texelFetch(extSplats, texel, 0), texelFetch(extSplats2, texel, 0), mean, rgba, squares, products);
  vec3 p = renderToViewBasis * mean + renderToViewPos;
  vec4 clip = projectionMatrix * vec4(p, 1.0);
  if (-clip.w > clip.z || clip.w <= 0.0) return;
  // Outside the image, the Jacobian grows without bound, so it is evaluated at most 15 % of the image size beyond the
  // edge.
  vec2 focal = 0.5 * renderSize * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  // The image of a headset's eye is not symmetric.
  vec2 middle = vec2(projectionMatrix[2][0], projectionMatrix[2][1]) * 0.5 * renderSize / focal;
  vec2 slope = middle + clamp(p.xy / -p.z - middle, -0.65 * renderSize / focal, 0.65 * renderSize / focal);
  vec3 right = vec3(focal.x, 0.0, focal.x * slope.x) / -p.z;
  vec3 up = vec3(0.0, focal.y, focal.y * slope.y) / -p.z;
  right = right * renderToViewBasis;
  up = up * renderToViewBasis;
  mat3 covariance = mat3(
    squares.x, products.x, products.y, products.x, squares.y, products.z, products.y, products.z, squares.z);
  vec3 spread = covariance * right;
  float a = dot(right, spread), b = dot(up, spread), d = dot(up, covariance * up);
  float sharp = a * d - b * b;
  a += 0.3;
  d += 0.3;
  // The low-pass filter increases the area of a splat by the inverse of this factor.
  if (antialiased) rgba.a *= sqrt(max(sharp / (a * d - b * b), 1e-12));
  float cut = log(255.0 * rgba.a);
  if (!(cut > 0.0)) return;
  float half_ = 0.5 * (a - d), root = sqrt(half_ * half_ + b * b), mid = 0.5 * (a + d);
  float large = mid + root, small = max(mid - root, 0.3);
  vec2 along = half_ > 0.0 ? vec2(half_ + root, b) : vec2(b, root - half_);
  vec2 axis = root < 1e-6 * mid ? vec2(1.0, 0.0) : normalize(along);
  float reach = sqrt(2.0 * cut);
  vec2 offset = reach * (position.x * sqrt(large) * axis + position.y * sqrt(small) * vec2(-axis.y, axis.x));
  heightOverFloor = vec3(0.0);
  if (floorDepth > 0.0) {
    /* World z of the mean, and of the densest point along the ray of a pixel, which is linear in the pixel. */
    vec3 upInView = vec3(viewMatrix[2]);
    vec3 spreadUp = covariance * (upInView * renderToViewBasis);
    vec2 shared = vec2(dot(right, spreadUp), dot(up, spreadUp));
    vec2 perAxis = vec2(dot(shared, axis) / sqrt(large), dot(shared, vec2(-axis.y, axis.x)) / sqrt(small));
    heightOverFloor = vec3(perAxis, dot(upInView, p - viewMatrix[3].xyz));
  }
  vec2 outside = abs(clip.xy) / clip.w * renderSize - renderSize;
  if (max(outside.x, outside.y) > 2.0 * reach * sqrt(large)) return;
  offsetInSigmas = reach * position.xy;
  gl_Position = vec4(clip.xy + 2.0 * offset / renderSize * clip.w, clip.zw);
}`;

const FRAGMENT = /* glsl */ `
precision highp float;
uniform float floorDepth;
in vec2 offsetInSigmas;
flat in vec4 rgba;
flat in vec3 heightOverFloor;
out vec4 colour;

void main() {
  float alpha = min(rgba.a * exp(-0.5 * dot(offsetInSigmas, offsetInSigmas)), 0.999);
  if (floorDepth > 0.0) {
    float height = heightOverFloor.z + dot(heightOverFloor.xy, offsetInSigmas);
    alpha *= smoothstep(-floorDepth, -0.2 * floorDepth, height);
  }
  if (alpha < 1.0 / 255.0) discard;
  colour = vec4(rgba.rgb * alpha, alpha);
}`;

export interface SplatRenderer {
  spark: SparkRenderer;
  /** Depth below the plane z = 0 from which an opaque floor there hides the splats, m; 0 without such a floor. */
  floorDepth: { value: number };
}

export function splatRenderer(
  renderer: THREE.WebGLRenderer,
  antialiased: boolean,
  onDirty: () => void,
): SplatRenderer {
  const splatCount = { value: 0 };
  const floorDepth = { value: 0 };
  const spark = new SparkRenderer({
    renderer,
    accumExtSplats: true,
    covSplats: true,
    enableLod: false,
    sortRadial: false,
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    extraUniforms: { splatCount, floorDepth, antialiased: { value: antialiased } },
    onDirty,
  });
  spark.geometry.dispose();
  spark.geometry = new QuadBatches(splatCount);
  const setUniforms = spark.onBeforeRender.bind(spark);
  spark.onBeforeRender = (...parameters) => {
    setUniforms(...parameters);
    // Spark uses the size of a headset's whole image, but each eye has only a part of it.
    const { viewport } = parameters[2] as THREE.PerspectiveCamera & { viewport?: THREE.Vector4 };
    if (viewport !== undefined) (spark.uniforms.renderSize.value as THREE.Vector2).set(viewport.z, viewport.w);
  };
  return { spark, floorDepth };
}

/** Detach a disposed renderer from the objects that Spark shares between all renderers. These objects would keep the
 * listeners of the renderer, and its last shader with its textures. Other renderers upload the objects again. */
export function releaseSharedObjects(): void {
  for (const { fullScreenQuad } of [SplatAccumulator, Readback]) {
    fullScreenQuad.material = new THREE.RawShaderMaterial({ visible: false });
    fullScreenQuad.dispose();
  }
  SplatAccumulator.emptyTexture.dispose();
  (SparkRenderer as unknown as { emptyOrdering: THREE.DataTexture }).emptyOrdering.dispose();
}
