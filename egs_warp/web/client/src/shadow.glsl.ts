// Light that reaches the ground under the creature, for the floor and for a captured ground.

/** Radius of the wide part of the shadow, as a fraction of the side of the shadow map. */
export const WIDE_RADIUS = 0.08;

export const SHADOW_GLSL = /* glsl */ `
/* Fraction of light at uv of a shadow map. Its red channel is the part of the sky that the body hides, its green
   channel marks what is close to the ground. The shadow at what touches the ground is spread over the radius
   softness. Coarser levels of the map make its few samples smooth. */
float egsShade(sampler2D shade, vec2 uv, float softness) {
  float near = 0.0, wide = 0.0, weights = 0.0;
  for (int k = 0; k < 12; k++) {
    float a = 2.399963 * float(k), r = softness * sqrt((float(k) + 0.5) / 12.0);
    near += textureLod(shade, uv + r * vec2(cos(a), sin(a)), 1.5).g;
  }
  for (int k = 0; k < 20; k++) {
    float a = 2.399963 * float(k), q = (float(k) + 0.5) / 20.0, weight = exp(-2.0 * q);
    wide += weight * textureLod(shade, uv + ${WIDE_RADIUS} * sqrt(q) * vec2(cos(a), sin(a)), 3.0).r;
    weights += weight;
  }
  return (1.0 - 0.45 * near / 12.0) * (1.0 - 0.4 * wide / weights);
}
`;
