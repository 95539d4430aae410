// Deformation of one splat in the shader. It computes the same values as egs_warp/kernels/deformation, but it needs no
// SVD, because its result is a covariance.

import { TEXTURE_WIDTH } from "./cage";
// The entries are explained in egs_warp/render/shadow.py.
import settings from "../../../render/shadow.json";
import { SHADOW_GLSL } from "./shadow.glsl";

/** Height over the ground at which a splat receives the shadow at half strength, in body heights. */
const MAX_BUMP = settings.max_bump * settings.reach;

export const DEFORM_GLSL = /* glsl */ `
vec4 egsTexel(sampler2D map, int k) { return texelFetch(map, ivec2(k % ${TEXTURE_WIDTH}, k / ${TEXTURE_WIDTH}), 0); }

struct EgsAffine { mat3 gradient; vec3 start; vec3 moved; };

EgsAffine egsAffine(sampler2D cage, int tet) {
  vec4 a = egsTexel(cage, 4 * tet), b = egsTexel(cage, 4 * tet + 1), c = egsTexel(cage, 4 * tet + 2);
  return EgsAffine(transpose(mat3(a.xyz, b.xyz, c.xyz)), egsTexel(cage, 4 * tet + 3).xyz, vec3(a.w, b.w, c.w));
}

vec3 egsImage(EgsAffine map, vec3 p) { return map.moved + map.gradient * (p - map.start); }

mat3 egsRotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

/* Rotation part of f by Newton's iteration (Higham 1986). */
mat3 egsPolar(mat3 f) {
  if (determinant(f) <= 1e-12) return mat3(1.0);
  for (int k = 0; k < 6; k++) f = 0.5 * (f + transpose(inverse(f)));
  return f;
}

vec3 egsArm(sampler2D cage, int tet, float share, int own, vec3 mean, vec3 movedMean, vec3 axis, vec3 ownAxis,
    float maxStretch) {
  if (tet == own) return ownAxis;
  EgsAffine end = egsAffine(cage, tet);
  vec3 endAxis = end.gradient * axis;
  if (share >= 0.0) return share * ownAxis + (1.0 - share) * endAxis;
  vec3 result = endAxis - (egsImage(end, mean) - movedMean) / share;
  float limit = maxStretch * max(length(ownAxis), length(endAxis)), size = length(result);
  return size > limit ? result * (limit / size) : result;
}

vec3 egsBand(sampler2D bands, mat4 scales, int at, int k) {
  return (egsTexel(bands, at + k).rgb * 255.0 - 128.0) / 127.0 * scales[k / 4][k % 4];
}

/* Colour of the spherical harmonics bands 1 to 3 in the unit direction d, with the signs of INRIA's convention. */
vec3 egsColour(sampler2D bands, mat4 scales, int index, int degree, vec3 d) {
  if (degree == 0) return vec3(0.0);
  int at = index * ((degree + 1) * (degree + 1) - 1);
  float x = d.x, y = d.y, z = d.z;
  #define B(k) egsBand(bands, scales, at, k)
  vec3 c = 0.4886025119029199 * (-y * B(0) + z * B(1) - x * B(2));
  if (degree > 1) {
    float xx = x * x, yy = y * y, zz = z * z;
    c += 1.0925484305920792 * (x * y * B(3) - y * z * B(4) - x * z * B(6));
    c += 0.31539156525252005 * (2.0 * zz - xx - yy) * B(5) + 0.5462742152960396 * (xx - yy) * B(7);
    if (degree > 2) {
      c += -0.5900435899266435 * (y * (3.0 * xx - yy) * B(8) + x * (xx - 3.0 * yy) * B(14));
      c += 2.890611442640554 * x * y * z * B(9) + 1.445305721320277 * z * (xx - yy) * B(13);
      c += -0.4570457994644658 * (4.0 * zz - xx - yy) * (y * B(10) + x * B(12));
      c += 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * B(11);
    }
  }
  #undef B
  return c;
}

${SHADOW_GLSL}
/* Fraction of light that reaches a background splat at p under the shadows of the creature. Splats near the ground
   receive them as in egs_warp/render/backdrop.py. */
float egsLight(sampler2D sky, vec4 skyRegion, sampler2D key, vec4 keyRegion, vec2 keySlope, vec3 p) {
  float near = clamp(1.5 - max(p.z, -0.5 * p.z) / (${MAX_BUMP.toFixed(4)} * skyRegion.w), 0.0, 1.0);
  float light = egsShade(sky, skyRegion, vec2(0.0), p);
  if (keyRegion.z > 0.0) light *= egsShade(key, keyRegion, keySlope, p);
  return mix(1.0, light, near);
}

/* Gain of the displayed colour of a splat whose normal n has rotated, as in egs_warp/kernels/lighting/relighting.py. */
float egsGain(mat4 form, vec3 n, mat3 turn) {
  float angle = acos(clamp(0.5 * (turn[0][0] + turn[1][1] + turn[2][2] - 1.0), -1.0, 1.0));
  float share = clamp((angle - 0.0175) / (0.07 - 0.0175), 0.0, 1.0);
  if (share == 0.0 || dot(n, n) < 0.25) return 1.0;
  vec4 before = vec4(normalize(n), 1.0), after = vec4(turn * before.xyz, 1.0);
  float ratio = max(dot(after, form * after), 0.2) / max(dot(before, form * before), 0.2);
  return mix(1.0, pow(clamp(ratio, 0.4, 2.5), 1.0 / 2.2), share);
}

/* The eye is in the axes of the splats; place is the transform from these axes to the world. */
CovSplat egsDeformed(
    int index, sampler2D splats, sampler2D arms, sampler2D bands, mat4 scales, sampler2D cage, sampler2D sky,
    vec4 skyRegion, sampler2D key, vec4 keyRegion, vec2 keySlope, vec3 eye, mat4 place, sampler2D normals,
    mat4 irradiance, int degree, float maxStretch) {
  vec4 a = egsTexel(splats, 4 * index), q = egsTexel(splats, 4 * index + 1);
  vec4 s = egsTexel(splats, 4 * index + 2), colour = egsTexel(splats, 4 * index + 3);
  vec3 mean = a.xyz;
  int code = int(a.w);
  bool straddles = code < 0;
  int tet = straddles ? -1 - code : code;
  mat3 axes = egsRotation(q);
  EgsAffine around = egsAffine(cage, tet);
  vec4 e = vec4(0.0), f = vec4(0.0), g = vec4(0.0), h = vec4(0.0);
  if (straddles) {
    int arm = 4 * int(colour.w);
    e = egsTexel(arms, arm); f = egsTexel(arms, arm + 1); g = egsTexel(arms, arm + 2); h = egsTexel(arms, arm + 3);
    /* Far outside the cage, the splat is only rotated and translated (RIGID). */
    if (f.z == 3.0) { around.gradient = egsPolar(around.gradient); straddles = false; }
  }
  vec3 moved = egsImage(around, mean);
  mat3 ownAxes = around.gradient * axes;
  mat3 stretched = ownAxes;
  if (straddles) {
    mat3 plus, minus;
    plus[0] = egsArm(cage, int(e.x), f.z, tet, mean, moved, axes[0], ownAxes[0], maxStretch);
    plus[1] = egsArm(cage, int(e.y), f.w, tet, mean, moved, axes[1], ownAxes[1], maxStretch);
    plus[2] = egsArm(cage, int(e.z), g.x, tet, mean, moved, axes[2], ownAxes[2], maxStretch);
    minus[0] = -egsArm(cage, int(e.w), g.y, tet, mean, moved, -axes[0], -ownAxes[0], maxStretch);
    minus[1] = -egsArm(cage, int(f.x), g.z, tet, mean, moved, -axes[1], -ownAxes[1], maxStretch);
    minus[2] = -egsArm(cage, int(f.y), g.w, tet, mean, moved, -axes[2], -ownAxes[2], maxStretch);
    moved += (plus - minus) * h.xyz;
    mat3 average = 0.5 * (plus + minus);
    if (determinant(average) > 0.0) stretched = average;
  }
  mat3 factor = mat3(stretched[0] * s.x, stretched[1] * s.y, stretched[2] * s.z);
  mat3 covariance = factor * transpose(factor);
  vec3 direction = normalize(moved - eye);
  if (degree > 0) direction = axes * (transpose(egsPolar(stretched)) * direction);
  CovSplat result;
  result.center = (place * vec4(moved, 1.0)).xyz;
  result.flags = GSPLAT_FLAG_ACTIVE;
  result.index = index;
  result.rgba = vec4(max(colour.rgb + egsColour(bands, scales, index, degree, direction), 0.0), s.w);
  if (irradiance[3][3] > 0.0) {
    vec3 n = (egsTexel(normals, index).rgb * 255.0 - 128.0) / 127.0;
    result.rgba.rgb *= egsGain(irradiance, n, egsPolar(stretched) * transpose(axes));
  }
  if (skyRegion.z > 0.0) result.rgba.rgb *= egsLight(sky, skyRegion, key, keyRegion, keySlope, moved);
  covariance = mat3(place) * covariance * transpose(mat3(place));
  result.xxyyzz = max(vec3(covariance[0][0], covariance[1][1], covariance[2][2]), 1e-16);
  result.xyxzyz = vec3(covariance[1][0], covariance[2][0], covariance[2][1]);
  return result;
}
`;
