// Contact shadow of bodies on a splat of another body. It computes the same values as
// egs_warp/kernels/contact/occlusion.py (docs/concepts/bodies.md#shadows).

import occlusion from "../../../contact/occlusion.json";

/** Texels of a body in the table of `BodyShadows`: box and decay length, grid, and lattice of the level set. */
export const OCCLUDER_TEXELS = 7;

export const OCCLUSION_GLSL = /* glsl */ `
/* Gradient of the level set at x, and its value as the last component: a triquadratic B-spline, as in
   egs_warp/kernels/contact/level_set.py. */
vec4 egsLevel(sampler2D levels, int first, vec3 counts, vec3 origin, float spacing, vec3 x) {
  vec3 u = (x - origin) / spacing;
  vec3 inner = clamp(u, vec3(0.5), counts - 1.5);
  vec3 nearest = clamp(floor(inner + 0.5), vec3(1.0), counts - 2.0);
  vec3 f = inner - nearest, outside = u - inner;
  vec3 w[3] = vec3[3](0.5 * (0.5 - f) * (0.5 - f), 0.75 - f * f, 0.5 * (0.5 + f) * (0.5 + f));
  vec3 s[3] = vec3[3](f - 0.5, -2.0 * f, f + 0.5);
  vec4 level = vec4(0.0);
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    vec2 corner = nearest.xy + vec2(i - 1, j - 1);
    int row = first + int((corner.x * counts.y + corner.y) * counts.z + nearest.z) - 1;
    vec3 c = vec3(egsTexel(levels, row).r, egsTexel(levels, row + 1).r, egsTexel(levels, row + 2).r);
    float sum = dot(c, vec3(w[0].z, w[1].z, w[2].z)), slope = dot(c, vec3(s[0].z, s[1].z, s[2].z));
    level += vec4(s[i].x * w[j].y * sum, w[i].x * s[j].y * sum, w[i].x * w[j].y * slope, w[i].x * w[j].y * sum);
  }
  level.xyz /= spacing;
  float off = length(outside);
  if (off > 0.0) {
    level.xyz = mix(level.xyz, vec3(0.0), notEqual(outside, vec3(0.0))) + outside / off;
    level.w += spacing * off;
  }
  return level;
}

/* Fraction of the light at p that a body hides. */
float egsHidden(sampler2D table, sampler2D seeds, sampler2D levels, sampler2D cage, vec3 up, int body, vec3 p) {
  int row = ${OCCLUDER_TEXELS} * body;
  vec4 low = egsTexel(table, row), high = egsTexel(table, row + 1);
  if (any(lessThan(p, low.xyz)) || any(greaterThan(p, high.xyz))) return 0.0;
  vec4 corner = egsTexel(table, row + 2), cell = egsTexel(table, row + 3);
  vec3 at = clamp(floor((p - corner.xyz) / cell.xyz), vec3(0.0), vec3(corner.w - 1.0));
  int tet = int(egsTexel(seeds, int(cell.w + (at.x * corner.w + at.y) * corner.w + at.z)).r);
  if (tet < 0) return 0.0;
  EgsAffine map = egsAffine(cage, tet);
  mat3 back = inverse(map.gradient);
  vec4 lattice = egsTexel(table, row + 4), counts = egsTexel(table, row + 5);
  vec3 rest = map.start + back * (p - map.moved);
  vec4 level = egsLevel(levels, int(counts.w), counts.xyz, lattice.xyz, lattice.w, rest);
  float slope = length(level.xyz);
  if (slope < 1e-9) return 0.0;
  vec3 g = level.xyz * back;
  float size = length(g), gap = level.w / (size * max(1.0, 0.5 / slope));
  return ${occlusion.max_opacity} * exp(-max(gap, 0.0) / low.w) * 0.5 * (1.0 - dot(g / size, up));
}

/* Fraction of light that the other bodies leave to a splat with mean p. */
float egsUnhidden(
    int index, sampler2D splats, sampler2D cage, sampler2D table, sampler2D seeds, sampler2D levels, vec3 up, vec3 p) {
  int code = int(egsTexel(splats, 4 * index).w);
  int body = int(egsTexel(cage, 4 * (code < 0 ? -1 - code : code) + 3).w);
  if (body < 0) return 1.0;
  vec4 near = egsTexel(table, ${OCCLUDER_TEXELS} * body + 6);
  float light = 1.0;
  for (int k = 0; k < int(near.y); k++) {
    int other = int(egsTexel(table, int(near.x) + k).r);
    light *= 1.0 - egsHidden(table, seeds, levels, cage, up, other, p);
  }
  return light;
}
`;
