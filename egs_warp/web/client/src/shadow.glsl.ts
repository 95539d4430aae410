// Fraction of light that reaches the ground under the creature, for the drawn floor and for a captured ground.

export const SHADOW_GLSL = /* glsl */ `
/* Fraction of light that a shadow map leaves to a point p. region contains the centre (x, y) of the map, half of its
side length, and the body height; slope is the displacement of the shadow per unit of height. */
float egsShade(sampler2D map, vec4 region, vec2 slope, vec3 p) {
  vec2 uv = 0.5 + 0.5 * (p.xy - slope * p.z - region.xy) / region.z;
  float light = 1.0 - textureLod(map, uv, 0.0).r;
  return all(lessThan(abs(uv - 0.5), vec2(0.5))) ? light : 1.0;
}
`;
