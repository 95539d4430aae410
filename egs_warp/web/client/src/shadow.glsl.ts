// Fraction of light that reaches the ground under the creature, for the drawn floor and for a captured ground.

/** Width of the edge of a shadow map on which the shadow fades, relative to the side of the map. */
const FADE = 0.04;

export const SHADOW_GLSL = /* glsl */ `
/* Fraction of light that a shadow map leaves to a point p. region contains the centre (x, y) of the map, half of its
side length, and the body height; slope is the displacement of the shadow per unit of height. The shadow fades at the
edges of the map. */
float egsShade(sampler2D map, vec4 region, vec2 slope, vec3 p) {
  vec2 uv = 0.5 + 0.5 * (p.xy - slope * p.z - region.xy) / region.z;
  vec2 fade = clamp((0.5 - abs(uv - 0.5)) / ${FADE}, 0.0, 1.0);
  return 1.0 - fade.x * fade.y * textureLod(map, uv, 0.0).r;
}
`;
