// Fraction of light that reaches the ground under the creature, for the drawn floor and for a captured ground.

/** Radius of the wide part of the shadow, as a fraction of the side of the shadow map for one body. */
export const WIDE_RADIUS = 0.08;

const GOLDEN_ANGLE = 2.399963;
const NEAR_SAMPLES = 6;
const WIDE_SAMPLES = 10;

/** Offset of sample k on a disc of radius 1; the circle through the sample encloses the fraction (k + 0.5) / count of
 * the disc's area. */
function discOffset(k: number, count: number): string {
  const radius = Math.sqrt((k + 0.5) / count);
  const [x, y] = [radius * Math.cos(GOLDEN_ANGLE * k), radius * Math.sin(GOLDEN_ANGLE * k)];
  return `vec2(${x.toFixed(6)}, ${y.toFixed(6)})`;
}

function nearSample(k: number): string {
  return `near += textureLod(shade, uv + spread * softness * ${discOffset(k, NEAR_SAMPLES)}, 1.5).gb;`;
}

const WIDE_WEIGHTS = Array.from({ length: WIDE_SAMPLES }, (_, k) => Math.exp((-2 * (k + 0.5)) / WIDE_SAMPLES));
const WIDE_TOTAL = WIDE_WEIGHTS.reduce((sum, weight) => sum + weight, 0);

function wideSample(k: number): string {
  const share = (WIDE_WEIGHTS[k]! / WIDE_TOTAL).toFixed(6);
  return `wide += ${share} * textureLod(shade, uv + spread * ${WIDE_RADIUS} * ${discOffset(k, WIDE_SAMPLES)}, 3.0).r;`;
}

export const SHADOW_GLSL = /* glsl */ `
/* Fraction of light at uv of a shadow map. The red channel of the map is the part of the sky that the body hides, the
green channel marks the parts of the body close to the ground, and the blue channel is the shadow of the main light. The
shadows around a contact and of the light are spread over the radius softness. Coarser levels of the map smooth the few
samples. spread is the side of a map for one body of the same height, divided by the side of this map. */
float egsShade(sampler2D shade, vec2 uv, float softness, float spread) {
  vec2 near = vec2(0.0);
  float wide = 0.0;
  ${Array.from({ length: NEAR_SAMPLES }, (_, k) => nearSample(k)).join("\n  ")}
  ${Array.from({ length: WIDE_SAMPLES }, (_, k) => wideSample(k)).join("\n  ")}
  near /= ${NEAR_SAMPLES}.0;
  return (1.0 - 0.55 * near.x) * (1.0 - 0.4 * wide) * (1.0 - near.y);
}
`;
